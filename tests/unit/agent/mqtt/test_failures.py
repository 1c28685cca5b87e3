"""The explanation of a failed connection."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest
from awscrt import mqtt5

from iort_agent.identity import Validity
from iort_agent.mqtt.failures import Cause, Causes, Hangups, why_not_connected

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
        (
            failed(code=REFUSED),
            GOOD._replace(not_before_s=NOW_S + 1),
            True,
            ("validity", True),
            "set the clock",
        ),
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
