"""Echo: the pong has the ping's content and goes only to the ping's robot."""

from __future__ import annotations

import json

import pytest
from hypothesis import given
from hypothesis import strategies as st

from functions import echo
from iort_contract.limits import ContractError
from iort_contract.messages.envelope import rule_event
from iort_contract.messages.live import decode_pong, encode_ping
from iort_contract.tables import PING_FIELDS, RECEIVED_MS, TOPIC
from iort_contract.topics import LAMBDA, PING, PONG, build_topic

robots = st.from_regex(r"[A-Za-z0-9_-]{1,64}", fullmatch=True)


def event(robot="car", namespace="iort", ping_id=7, sent_us=1_700_000_000_000_000, padding=""):
    """The event that the echo rule makes from a ping."""
    ping = encode_ping(ping_id, sent_us, padding)
    return rule_event(ping, build_topic(PING, robot, LAMBDA, namespace), 1_700_000_000_123)


@given(
    robots, st.from_regex(r"[a-z][a-z0-9]{0,15}", fullmatch=True), st.integers(0, 2**53), st.text(max_size=9)
)
def test_the_pong_has_the_pings_content(robot, namespace, ping_id, padding):
    topic, payload = echo.pong(event(robot, namespace, ping_id, padding=padding))
    assert topic == build_topic(PONG, robot, LAMBDA, namespace)
    assert decode_pong(payload) == (ping_id, 1_700_000_000_000_000, 1_700_000_000_123)
    content = json.loads(payload)
    assert content.get("padding", "") == padding
    assert set(content) <= {*PING_FIELDS, RECEIVED_MS}


@pytest.mark.parametrize(
    "bad",
    [
        *(
            {**event(), TOPIC: topic}
            for topic in ("ping/iort/car", "ping/iort/ca+r/lambda", "ping/iort/#/lambda", "", None, 7)
        ),
        *(
            rule_event(message, build_topic(PING, "car", LAMBDA), 1)
            for message in (b"no JSON", b"\xff", b"[]", b"1", b"", b"[" * 100_000)
        ),
    ],
)
def test_what_is_no_ping_is_refused(bad):
    with pytest.raises(ContractError, match=r"topic|robot|ping is"):
        echo.pong(bad)


def test_the_handler_publishes_and_counts(invoke, published, capsys):
    invoke(echo.handler, event())
    assert published() == [echo.pong(event())]
    assert json.loads(capsys.readouterr().out)["PongsSent"] == 1
