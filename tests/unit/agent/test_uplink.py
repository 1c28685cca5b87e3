"""Why a connection failed, when to try again, and whose answers confirm a subscription."""

from __future__ import annotations

import random
from concurrent.futures import Future
from types import SimpleNamespace
from typing import Any, Callable

import pytest
from awscrt import mqtt5
from hypothesis import given
from hypothesis import strategies as st

from iort_agent.identity import Validity
from iort_agent.mqtt.dispatch import Dispatcher, Subscriptions
from iort_agent.mqtt.failures import HANGUPS, Backoff, Cause, Causes, Hangups, why_not_connected

NOW_S = 1_700_000_000
GOOD = Validity(not_before_s=NOW_S - 10, not_after_s=NOW_S + 10)
REFUSED = mqtt5.ConnectReasonCode.NOT_AUTHORIZED
HUNG_UP, CLOSED = "AWS_ERROR_MQTT_UNEXPECTED_HANGUP", "AWS_IO_SOCKET_CLOSED"
TLS_FAILED = "AWS_IO_TLS_ERROR_NEGOTIATION_FAILURE"
DNS = "AWS_IO_DNS_INVALID_NAME"


def failed(name: str = HUNG_UP, code: Any = None) -> Any:
    packet = None if code is None else SimpleNamespace(reason_code=code, reason_string=None)
    return SimpleNamespace(exception=SimpleNamespace(name=name, message="m"), connack_packet=packet)


@pytest.mark.parametrize(
    ("data", "validity", "again", "expected", "words"),
    [
        (failed(DNS), GOOD, False, (f"the endpoint's name does not resolve ({DNS})", False), "resolve"),
        (failed(HUNG_UP), GOOD, False, ("", False), "closed the connection"),
        (failed(HUNG_UP), GOOD, True, (f"hangup {HUNG_UP}", True), "unknown, inactive or revoked"),
        (failed(CLOSED), GOOD, True, (f"hangup {CLOSED}", False), "again and again"),
        (failed(code=REFUSED), GOOD, False, ("refused", True), "not attached to a thing named car7"),
        (failed(HUNG_UP), GOOD._replace(not_after_s=NOW_S - 1), False, ("validity", True), "expired on 2023"),
        (failed(code=REFUSED), GOOD._replace(not_before_s=NOW_S + 1), True, ("validity", True), "the clock"),
        # The certificate cannot be the reason, so it is not read.
        (failed(DNS), GOOD._replace(not_after_s=NOW_S - 1), True, ("", False), "resolve"),
        (failed(code=REFUSED), None, False, ("refused", True), "iort-agent check"),
    ],
)
def test_each_failure_has_its_cause(
    data: Any, validity: Validity | None, again: bool, expected: tuple[str, bool], words: str
) -> None:
    cause = why_not_connected(
        data,
        client_id="car7",
        validity=lambda: validity,
        now_us=NOW_S * 1_000_000,
        hung_up=lambda before_tls: Hangups(again, again and not before_tls),
    )
    assert words in cause.text
    kind, slow = expected
    assert cause.slow is slow
    assert not kind or cause[0] == kind


def test_resets_before_tls_and_while_it_begins_are_one_cause_that_is_told_twice() -> None:
    """A proxy without a broker resets connections; when, only its machine's load decides."""
    causes = Causes()

    def found(name: str) -> Cause:
        return why_not_connected(
            failed(name),
            client_id="car7",
            validity=lambda: GOOD,
            now_us=NOW_S * 1_000_000,
            hung_up=causes.hung_up,
        )

    told = [(causes.is_news(cause), cause.slow) for cause in map(found, (CLOSED, TLS_FAILED) * 3)]
    assert told == [(True, False), (False, False), (True, False), *[(False, False)] * 3]


class Least(random.Random):
    def random(self) -> float:
        return 0.0


class Most(random.Random):
    def random(self) -> float:
        return 1.0


@given(st.lists(st.booleans(), max_size=40), st.integers())
def test_never_below_a_second_nor_above_the_cap(slow: list[bool], seed: int) -> None:
    backoff = Backoff(random.Random(seed))
    for one in slow:
        low, high = (60, 300) if one else (1, 30)
        assert low <= backoff.next_s(slow=one) <= high


def test_the_ceiling_doubles_and_the_first_wait_is_jittered_too() -> None:
    backoff = Backoff(Most())
    assert [backoff.next_s() for _ in range(6)] == [2, 4, 8, 16, 30, 30]
    assert [backoff.next_s(slow=True) for _ in range(4)] == [120, 240, 300, 300]
    backoff.reset()
    assert backoff.next_s(slow=True) == 120
    assert backoff.next_s() == 2, "another kind of cause begins anew"
    assert [Backoff(Least()).next_s() for _ in range(3)] == [1, 1, 1]


def test_a_cause_is_news_once() -> None:
    causes = Causes()
    a, b = Cause("a", "first"), Cause("b", "second")
    assert [causes.is_news(cause) for cause in (a, a, Cause("a", "other words"), b, a)] == [
        True, False, False, True, True,
    ]  # fmt: skip
    causes.connected()
    assert causes.is_news(a)


@pytest.mark.parametrize("before_tls", [False, True])
def test_only_disconnects_in_a_row_become_a_refusal(before_tls: bool) -> None:
    causes = Causes()
    told = [causes.hung_up(before_tls=before_tls) for _ in range(HANGUPS)]
    assert told == [(False, False)] * (HANGUPS - 1) + [(True, not before_tls)]
    causes.connected()
    assert causes.hung_up(before_tls=before_tls) == (False, False)


def test_a_reset_that_looks_like_a_tls_failure_is_not_a_refusal() -> None:
    causes = Causes()
    told = [causes.hung_up(before_tls=bool(i % 2)) for i in range(2 * HANGUPS)]
    assert told == [(i + 1 >= HANGUPS, False) for i in range(2 * HANGUPS)]


FILTER = "cmd/iort/car/#"


def agreed() -> Future[Any]:
    future: Future[Any] = Future()
    future.set_result(SimpleNamespace(reason_codes=[1], reason_string=None))
    return future


def test_an_answer_of_an_earlier_connection_is_ignored() -> None:
    asked: list[Callable[[Future[Any]], None]] = []
    dispatcher = Dispatcher()
    subscriptions = Subscriptions(
        dispatcher, subscribe=lambda _, done: asked.append(done), usable=lambda: True, refused=print
    )
    subscriptions.add(FILTER, print)
    dispatcher.run_pending()
    # The dispatcher is busy until after the loss and the next connect.
    subscriptions.lost()
    asked[0](agreed())
    assert not subscriptions.confirmed
    subscriptions.renew()
    assert len(asked) == 2
    asked[1](agreed())
    assert subscriptions.confirmed == {FILTER}
    subscriptions.renew()
    assert len(asked) == 2
