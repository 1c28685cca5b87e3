"""No rule mistakes a key of a robot's message for a key that the cloud adds."""

from __future__ import annotations

import json

import pytest

from functions import alert, echo, presence
from iort_contract.catalog.rules import RULES
from iort_contract.catalog.vesc import FAULT_FIELD, VOLTAGE_FIELD
from iort_contract.cloud import DRIVER, VIEWER, claim_name, client_prefix
from iort_contract.messages.batch import Batch, decode_batch, decode_item, encode_batch
from iort_contract.messages.event import event_message
from iort_contract.messages.live import LiveSample, decode_pong, encode_live, encode_ping
from iort_contract.tables import (
    AGENT_VERSION,
    ENVELOPE,
    EXPIRES_S,
    MESSAGE_BASE64,
    NONFINITE,
    PREVIOUS,
    RECEIVED_MS,
    ROBOT,
    TOPIC,
)
from iort_contract.topics import ASK, FILE, LAMBDA, LIVE, PING, PONG, RECORD, RULE, SHADOW, build_topic
from tests.rule_sql import evaluate
from verify.tools.spoofing import spoofed

NOW_MS = 1_700_000_000_123
T_US = 1_700_000_000_000_000
RETENTION_S = 3600
BATCH = encode_batch(Batch("0badcafe", 3, [T_US], {"speed": [1.5]}, nonfinite=2, previous=()))
SAMPLE = {FAULT_FIELD: 3, VOLTAGE_FIELD: 9.5}
LIVE_MESSAGE = encode_live(LiveSample("0badcafe", 3, T_US, T_US, SAMPLE))
PING_MESSAGE = encode_ping(7, T_US, "padding")
REPORT = json.dumps({"state": {"reported": {AGENT_VERSION: "1.2.3", ROBOT: "b"}}}).encode()
CONNECTED = json.dumps(
    {"clientId": "a", "eventType": "connected", "timestamp": NOW_MS, "versionNumber": 1}
    | {"principalIdentifier": "f" * 64}
).encode()

# By rule: lane and name of the topic of robot a, and the honest message.
SENT = {
    "record": (RECORD, "vesc", BATCH),
    "live": (LIVE, "vesc", LIVE_MESSAGE),
    "fault": (LIVE, "vesc", LIVE_MESSAGE),
    "battery": (LIVE, "vesc", LIVE_MESSAGE),
    "pong": (PING, RULE, PING_MESSAGE),
    "echo": (PING, LAMBDA, PING_MESSAGE),
    "upload": (PING, FILE, PING_MESSAGE),
    "ask": (ASK, "calibration", PING_MESSAGE),
}
WHOSE = {rule: build_topic(lane, "a", name) for rule, (lane, name, _) in SENT.items()}


def of_rule(rule, topic, payload):
    """The event or item that a rule makes from a message on a topic."""
    return evaluate(RULES[rule].statement(retention_s=RETENTION_S), topic, payload, NOW_MS)


def test_every_rule_has_a_spoofed_message():
    assert {*SENT, "presence", "version"} == set(RULES)


@pytest.mark.parametrize("rule", SENT)
def test_a_rule_handles_a_spoofed_message_like_an_honest_one(rule):
    lane, name, message = SENT[rule]
    honest = of_rule(rule, WHOSE[rule], message)
    told = of_rule(rule, WHOSE[rule], spoofed(message, "b", lane, name))
    if MESSAGE_BASE64 in honest:
        assert event_message(honest) == message
        # The encoded message may hold any keys.
        assert event_message(told) == spoofed(message, "b", lane, name)
        honest, told = ({**one, MESSAGE_BASE64: ""} for one in (honest, told))
    assert told == honest
    assert told[RECEIVED_MS] == NOW_MS
    assert told.get(TOPIC, WHOSE[rule]) == WHOSE[rule]
    assert told.get(EXPIRES_S) == (NOW_MS // 1000 + RETENTION_S if rule == "record" else None)


def test_lambda_2_gets_the_robot_of_the_topic_and_its_batch():
    item = of_rule("record", WHOSE["record"], spoofed(BATCH, "b", RECORD, "vesc"))
    topic, batch = decode_item(item)
    assert (topic.robot, batch) == ("a", decode_batch(BATCH))
    assert set(item) == {*ENVELOPE, TOPIC, RECEIVED_MS, EXPIRES_S}


def test_a_batch_without_nonfinite_is_stored_without_it():
    message = encode_batch(Batch("0badcafe", 3, [T_US], {"speed": [1.5]}))
    item = of_rule("record", WHOSE["record"], message)
    assert not {NONFINITE, PREVIOUS} & set(item)
    assert decode_item(item)[1] == decode_batch(message)


def test_the_echo_goes_to_the_robot_of_the_topic_with_the_clouds_time():
    event = of_rule("echo", WHOSE["echo"], spoofed(PING_MESSAGE, "b", PING, LAMBDA))
    topic, payload = echo.pong(event)
    assert topic == build_topic(PONG, "a", LAMBDA)
    assert decode_pong(payload) == (7, T_US, NOW_MS)
    assert json.loads(payload) == {**json.loads(PING_MESSAGE), RECEIVED_MS: NOW_MS}


def test_the_rules_pong_has_the_clouds_time():
    answer = of_rule("pong", WHOSE["pong"], spoofed(PING_MESSAGE, "b", PING, RULE))
    assert decode_pong(json.dumps(answer)) == (7, T_US, NOW_MS)


@pytest.mark.parametrize("rule", ["fault", "battery"])
def test_an_alert_names_the_robot_of_the_topic(rule):
    event = of_rule(rule, WHOSE[rule], spoofed(LIVE_MESSAGE, "b", LIVE, "vesc"))
    told = []

    class Everything:
        def take(self, robot, _key, _now_s):
            return robot == "a"

    def notify(*mail):
        told.append(mail)

    alert.process(event, 10.5, Everything(), notify, NOW_MS // 1000)
    ((subject, text),) = told
    assert subject.startswith("iort: a, ")
    assert "2023-11-14 22:13:20 UTC" in text


def test_a_version_belongs_to_the_robot_of_the_shadows_topic():
    topic = f"$aws/things/a/shadow/name/{SHADOW}/update/accepted"
    document = json.loads(spoofed(REPORT, "b", LIVE, "vesc"))
    event = of_rule("version", topic, json.dumps(document).encode())
    assert event == {AGENT_VERSION: "1.2.3", ROBOT: "a"}
    assert presence.change(event)["Key"] == {ROBOT: {"S": "a"}}
    assert of_rule("version", topic, b'{"state": {"reported": {}}}') is None


def test_the_brokers_own_event_is_passed_on_unchanged():
    event = of_rule("presence", "$aws/events/presence/connected/a", CONNECTED)
    assert event == json.loads(CONNECTED)
    assert presence.change(event)["Key"] == {ROBOT: {"S": "a"}}
    assert of_rule("presence", "$aws/events/presence/x/a", b'{"eventType": "connect_failed"}') is None


# "Lifecycle events": a certificate's id, or IAM credentials.
CERTIFICATE, SESSION = "0123456789abcdef" * 4, "AROAEXAMPLEEXAMPLEEX:CognitoIdentityCredentials"


@pytest.mark.parametrize("kind", ["connected", "disconnected"])
@pytest.mark.parametrize(
    ("client", "principal", "noted"),
    [
        ("a", CERTIFICATE, True),
        ("iort-viewer-robot", CERTIFICATE, True),
        (f"{client_prefix(VIEWER)}0a1b2c3d", SESSION, False),
        (f"{client_prefix(DRIVER)}0a1b2c3d", SESSION, False),
        (f"{claim_name()}-0a1b2c3d", CERTIFICATE, False),
        # A role that a page or program of another deployment has.
        ("a", SESSION, False),
        ("a", "AIDAEXAMPLEEXAMPLEEX", False),
    ],
)
def test_presence_is_called_for_robots_only(client, principal, kind, noted):
    event = {**json.loads(CONNECTED), "clientId": client, "principalIdentifier": principal, "eventType": kind}
    sent = json.dumps(event).encode()
    assert (of_rule("presence", f"$aws/events/presence/{kind}/{client}", sent) is not None) == noted
