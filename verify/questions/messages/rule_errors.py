"""Rules of this file's own: AWS' document for an error action, and a star beside a key."""

from __future__ import annotations

import json
import uuid
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

from functions.quarantine import entries
from iort_contract.tables import TOPIC
from iort_contract.topics import PING, PONG, RULE, build_topic, rule_name
from testkit.target import Target
from testkit.waiting import InstrumentError, until
from verify.question import Seen, question
from verify.tools.robots import Pair, pair_of

_GUIDE = "https://docs.aws.amazon.com/iot/latest/developerguide"


@contextmanager
def _rule(
    target: Target, select: str, topic: str, *, action: Mapping[str, Any], error: Mapping[str, Any]
) -> Iterator[str]:
    """A rule for this question; yields its name."""
    iot, name = target.cloud.client("iot"), f"{target.cloud.namespace}_verify_{uuid.uuid4().hex[:8]}"
    payload: Any = {
        "sql": f"{select} FROM '{topic}'",
        "awsIotSqlVersion": "2016-03-23",
        "actions": [action],
        "errorAction": error,
    }
    iot.create_topic_rule(ruleName=name, topicRulePayload=payload)
    try:
        yield name
    finally:
        iot.delete_topic_rule(ruleName=name)


def _republishing(target: Target, topic: str) -> dict[str, Any]:
    """An action in the name of the rule pong, which may publish only to robots' pongs."""
    rule = target.cloud.client("iot").get_topic_rule(ruleName=rule_name("pong", target.cloud.namespace))
    (pong,) = rule["rule"]["actions"]
    return {"republish": {"roleArn": pong["republish"]["roleArn"], "topic": topic, "qos": 1}}


def _heard(pair: Pair, topic: str, payload: bytes) -> bytes:
    """The answer to the operator's message, which is repeated until the rule is active."""
    data = pair.target.cloud.client("iot-data")

    def heard() -> bytes | None:
        data.publish(topic=topic, qos=1, payload=payload)
        try:
            return pair.robot.next_message(within_s=2)[1]
        except InstrumentError:
            return None

    return until(heard, f"the rule's answer to {topic}", within_s=50)


@question(
    "rule_errors.document",
    expected={
        "source": "rule NAME",
        "robot_is_the_topics": True,
        "topic_as_published": True,
        "payload_as_published": True,
        "says_why": True,
    },
    source=f"{_GUIDE}/rule-error-handling.html and {_GUIDE}/iot-basic-ingest.html",
    relied_on_by=("functions/quarantine.py", "contract/iort_contract/topics.py"),
)
def document(target: Target) -> Seen:
    """A rule whose action fails gives its error action the topic, the original payload in base64 and the
    reasons. The quarantine reads that, with or without Basic Ingest's prefix before the topic."""
    cloud = target.cloud
    with pair_of(target, "verify-error-document") as pair:
        heard_on = build_topic(PONG, pair.robot.name, RULE, cloud.namespace)
        pair.robot.subscribe(heard_on)
        topic = build_topic(PING, pair.robot.name, "error", cloud.namespace)
        told = _republishing(target, heard_on)
        # The role of the rule pong may not write to the table, and the message lacks the table's key.
        table = {"tableName": cloud.output("storage", "TelemetryTable")}
        fails = {"dynamoDBv2": {"roleArn": told["republish"]["roleArn"], "putItem": table}}
        with _rule(target, "SELECT *", topic, action=fails, error=told) as name:
            body = _heard(pair, f"$aws/rules/{name}/{topic}", b'{"v": 1}').decode()
    document = json.loads(body)
    (entry,) = entries(body, lambda _: ())
    return {
        "source": entry.source.replace(name, "NAME"),
        "robot_is_the_topics": entry.robot == pair.robot.name,
        "topic_as_published": entry.topic == topic,
        "payload_as_published": entry.payload == b'{"v": 1}',
        "says_why": entry.reason != "no reason given",
        "note_keys": sorted(document),
        "note_keys_of_a_failure": sorted(document["failures"][0]),
        "note_topic_has_the_prefix": document["topic"] != topic,
    }


@question(
    "rule_errors.star_beside_a_key",
    expected={"other_keys_stay": True},
    source=f"{_GUIDE}/iot-sql-select.html",
    relied_on_by=("docs/decisions/security/0033-no-mixed-keys.md",),
)
def star_beside_a_key(target: Target) -> Seen:
    """SELECT * with a key beside it adds the key to the payload. AWS does not document which one stays if
    the payload has the same key; no rule of this project depends on it."""
    with pair_of(target, "verify-star") as pair:
        heard_on = build_topic(PONG, pair.robot.name, RULE, target.cloud.namespace)
        pair.robot.subscribe(heard_on)
        topic = build_topic(PING, pair.robot.name, "star", target.cloud.namespace)
        told = _republishing(target, heard_on)
        with _rule(target, f"SELECT *, topic() AS {TOPIC}", topic, action=told, error=told):
            body = _heard(pair, topic, json.dumps({TOPIC: "the message's", "kept": 1}).encode())
    stays = {"the message's": "the message's", topic: "the rule's"}
    members: list[tuple[str, Any]] = json.loads(body, object_pairs_hook=list)
    return {
        "other_keys_stay": ("kept", 1) in members,
        "note_topic_is": [stays.get(value, "another") for name, value in members if name == TOPIC],
    }
