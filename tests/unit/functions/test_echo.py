"""Echo: the pong has the ping's content and goes only to the ping's robot."""

from __future__ import annotations

import json

import pytest
from hypothesis import given
from hypothesis import strategies as st

from functions import echo
from iort_contract.catalog.environments import EchoEnvironment
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
    "topic", ["ping/iort/car", "ping/iort/ca+r/lambda", "ping/iort/#/lambda", "", None, 7]
)
def test_an_invalid_topic_is_refused(topic):
    with pytest.raises(ContractError, match=r"topic|robot"):
        echo.pong({**event(), TOPIC: topic})


@pytest.mark.parametrize("message", [b"no JSON", b"\xff", b"[]", b"1", b"", b"[" * 100_000])
def test_an_invalid_ping_goes_to_the_quarantine_and_fails_nothing(message):
    bad, sent, bodies = rule_event(message, build_topic(PING, "car", LAMBDA), 1), [], []
    echo.serve(bad, "arn", publish=lambda *pong: sent.append(pong), keep=lambda body: not bodies.append(body))
    (body,) = map(json.loads, bodies)
    assert body["requestPayload"] == bad
    assert "ping is" in body["responsePayload"]["errorMessage"]
    assert sent == []
    with pytest.raises(ContractError, match="ping is"):
        echo.serve(bad, "arn", publish=lambda *pong: sent.append(pong), keep=lambda _body: False)


def test_the_handler_publishes_through_boto3(aws, capsys, monkeypatch):
    from moto.backends import get_backend
    from moto.core import DEFAULT_ACCOUNT_ID

    class Context:
        invoked_function_arn = "arn"

    for name, value in EchoEnvironment("iort", "queue").variables().items():
        monkeypatch.setenv(name, value)
    echo.handler(event(), Context)
    backend = get_backend("iot-data")[DEFAULT_ACCOUNT_ID]["eu-west-1"]
    topic, payload = echo.pong(event())
    assert backend.published_payloads == [(topic, payload)]
    assert json.loads(capsys.readouterr().out)["PongsSent"] == 1
