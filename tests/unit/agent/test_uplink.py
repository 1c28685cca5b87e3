"""Why a connection failed, when to try again, and whose answers confirm a subscription."""

from __future__ import annotations

import random
import socket
import struct
from concurrent.futures import Future
from contextlib import closing
from types import SimpleNamespace
from typing import Any, Callable

import pytest
from awscrt import mqtt5
from hypothesis import given
from hypothesis import strategies as st

from iort_agent.identity import Validity
from iort_agent.mqtt.client import Network
from iort_agent.mqtt.dispatch import Dispatcher, Subscriptions
from iort_agent.mqtt.failures import (
    DOUBTFUL,
    HANGUPS,
    REFUSED,
    UNREACHED,
    UNSTEADY,
    Backoff,
    Cause,
    Causes,
    Hangups,
    Pace,
    why_not_connected,
)

NOW_S = 1_700_000_000
GOOD = Validity(not_before_s=NOW_S - 10, not_after_s=NOW_S + 10)
LATE = GOOD._replace(not_after_s=NOW_S - 1)
UNAUTHORIZED = mqtt5.ConnectReasonCode.NOT_AUTHORIZED
HUNG_UP, CLOSED = "AWS_ERROR_MQTT_UNEXPECTED_HANGUP", "AWS_IO_SOCKET_CLOSED"
TLS_FAILED = "AWS_IO_TLS_ERROR_NEGOTIATION_FAILURE"
DNS, NO_NETWORK = "AWS_IO_DNS_INVALID_NAME", "AWS_IO_SOCKET_NO_ROUTE_TO_HOST"


def failed(name: str = HUNG_UP, code: Any = None) -> Any:
    packet = None if code is None else SimpleNamespace(reason_code=code, reason_string=None)
    return SimpleNamespace(exception=SimpleNamespace(name=name, message="m"), connack_packet=packet)


@pytest.mark.parametrize(
    ("data", "validity", "again", "expected", "words"),
    [
        (failed(DNS), GOOD, False, (f"the endpoint's name does not resolve ({DNS})", UNREACHED), "resolve"),
        (failed(NO_NETWORK), GOOD, False, ("", UNREACHED), "there is no network"),
        (failed(HUNG_UP), GOOD, False, ("", UNSTEADY), "closed the connection"),
        (failed(HUNG_UP), GOOD, True, (f"hangup {HUNG_UP}", DOUBTFUL), "unknown, inactive or revoked"),
        (failed(CLOSED), GOOD, True, (f"hangup {CLOSED}", UNSTEADY), "again and again"),
        (failed(code=UNAUTHORIZED), GOOD, False, ("refused", REFUSED), "not attached to a thing named car7"),
        (failed(HUNG_UP), LATE, False, ("validity", REFUSED), "expired on 2023"),
        (
            failed(code=UNAUTHORIZED),
            GOOD._replace(not_before_s=NOW_S + 1),
            True,
            ("validity", REFUSED),
            "the clock",
        ),
        # The certificate cannot be the reason, so it is not read.
        (failed(DNS), LATE, True, ("", UNREACHED), "resolve"),
        (failed(code=UNAUTHORIZED), None, False, ("refused", REFUSED), "iort-agent check"),
    ],
)
def test_each_failure_has_its_cause(
    data: Any, validity: Validity | None, again: bool, expected: tuple[str, Pace], words: str
) -> None:
    cause = why_not_connected(
        data,
        client_id="car7",
        validity=lambda: validity,
        now_us=NOW_S * 1_000_000,
        hung_up=lambda before_tls: Hangups(again, again and not before_tls),
    )
    assert words in cause.text
    kind, pace = expected
    assert cause.pace == pace
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

    told = [(causes.is_news(cause), cause.pace.person) for cause in map(found, (CLOSED, TLS_FAILED) * 3)]
    assert told == [(True, False), (False, False), (True, False), *[(False, False)] * 3]


class Least(random.Random):
    def random(self) -> float:
        return 0.0


class Most(random.Random):
    def random(self) -> float:
        return 1.0


@given(st.lists(st.sampled_from([UNREACHED, UNSTEADY, DOUBTFUL, REFUSED]), max_size=40), st.integers())
def test_never_below_the_shortest_wait_nor_above_the_longest(paces: list[Pace], seed: int) -> None:
    backoff = Backoff(random.Random(seed))
    for pace in paces:
        assert pace.shortest_s <= backoff.next_s(pace) <= pace.longest_s


def test_the_ceiling_doubles_and_the_first_wait_is_jittered_too() -> None:
    backoff = Backoff(Most())
    assert [backoff.next_s() for _ in range(6)] == [2, 4, 8, 16, 30, 30]
    assert [backoff.next_s(REFUSED) for _ in range(4)] == [120, 240, 300, 300]
    assert [backoff.next_s(DOUBTFUL) for _ in range(5)] == [10, 20, 40, 60, 60]
    assert [backoff.next_s(UNREACHED) for _ in range(4)] == [2, 4, 5, 5]
    backoff.reset()
    assert backoff.next_s(UNREACHED) == 2
    assert backoff.next_s() == 2, "another kind of cause begins anew"
    assert [Backoff(Least()).next_s() for _ in range(3)] == [1, 1, 1]


def test_networks_that_come_and_do_not_help_hurry_less_each_time() -> None:
    backoff = Backoff(Least())
    waits = []
    for _ in range(7):
        backoff.next_s()
        # Each container that starts brings an address; only the first notice finds the attempt so near.
        waits.append([backoff.came_back_s(UNSTEADY, 0.0), backoff.came_back_s(UNSTEADY, 40.0)])
    assert waits == [[1, 0], [2, 0], [4, 0], [8, 0], [16, 0], [30, 0], [30, 0]]
    backoff.next_s()
    backoff.next_s()
    assert backoff.came_back_s(UNSTEADY, 0.0) == 1, "a wait without one begins anew"
    backoff.reset()
    backoff.next_s()
    assert backoff.came_back_s(REFUSED, 0.0) == 60
    assert Backoff(Most()).came_back_s(UNSTEADY, 10.0) == 2, "and a fleet spreads its attempts"


ADDRESS, ADDRESS_GONE, ROUTE, ROUTE_GONE = 20, 21, 24, 25


def notice(kind: int, size: int = 24) -> bytes:
    return struct.pack("=IHHII", size, kind, 0, 0, 0).ljust(size, b"\0")


@pytest.mark.parametrize(
    ("notices", "came"),
    [
        ([], False),
        ([notice(ADDRESS)], True),
        ([notice(ROUTE)], True),
        ([notice(ADDRESS_GONE), notice(ROUTE_GONE)], False),
        ([notice(ROUTE_GONE, 28) + notice(ROUTE)], True),
        # What is no message of netlink ends, and tells of nothing.
        ([bytes(40), b"short"], False),
    ],
)
def test_a_network_has_come_with_an_address_or_a_route(notices: list[bytes], came: bool) -> None:
    kernel, ours = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
    ours.setblocking(False)
    with kernel, closing(Network(ours)) as network:
        for data in notices:
            kernel.send(data)
        assert network.came() is came
        assert not network.came()


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
