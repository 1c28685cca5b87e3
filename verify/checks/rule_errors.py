"""What rules make of messages that fail, are no JSON, or are as large as AWS takes."""

from __future__ import annotations

import json
import uuid
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

from bench.target import Target
from contract import (
    FLEET,
    LIVE,
    MAX_MESSAGE_BYTES,
    PING,
    PONG,
    RECEIVED_MS,
    RECORD,
    RULE,
    TOPIC,
    VESC_STREAM,
    build_topic,
    encode_ping,
    live_topic,
    record_topic,
    rule_name,
)
from functions.quarantine import entries
from station import quarantine
from station.quarantine import Entry
from verify.bundles import Pair, pair_of
from verify.check import Basis, Check
from verify.errors import VerifyError
from verify.robot import Robot
from verify.waiting import until

_GUIDE = "https://docs.aws.amazon.com/iot/latest/developerguide"
_QUOTAS = "https://docs.aws.amazon.com/general/latest/gr/iot-core.html"
# No JSON, and no UTF-8 either.
_BYTES = b"\xff\x00 no JSON"
_AWS_MESSAGE_BYTES = 128 * 1024


@contextmanager
def _rule(target: Target, sql: str, action: Mapping[str, Any], error: Mapping[str, Any]) -> Iterator[str]:
    """A rule of this question's own; its name."""
    iot, name = target.cloud.client("iot"), f"{target.cloud.namespace}_verify_{uuid.uuid4().hex[:8]}"
    payload = {"sql": sql, "awsIotSqlVersion": "2016-03-23", "actions": [action], "errorAction": error}
    iot.create_topic_rule(ruleName=name, topicRulePayload=payload)
    try:
        yield name
    finally:
        iot.delete_topic_rule(ruleName=name)


def _republishing(target: Target, topic: str) -> dict[str, Any]:
    """An action in the name of the rule pong, which may publish to robots' pongs alone."""
    rule = target.cloud.client("iot").get_topic_rule(ruleName=rule_name("pong", target.cloud.namespace))
    (pong,) = rule["rule"]["actions"]
    return {"republish": {"roleArn": pong["republish"]["roleArn"], "topic": topic, "qos": 1}}


def _heard(pair: Pair, topic: str, payload: bytes) -> bytes:
    """What comes back for a message that the operator publishes; again, as long as the rule is not there."""
    data = pair.target.cloud.client("iot-data")

    def heard() -> bytes | None:
        data.publish(topic=topic, qos=1, payload=payload)
        try:
            return pair.robot.next_message(within_s=2)[1]
        except VerifyError:
            return None

    return until(heard, f"the rule's answer to {topic}", within_s=50)


def _error_document(target: Target) -> dict[str, Any]:
    cloud = target.cloud
    with pair_of(target, "verify-error-document") as pair:
        heard_on = build_topic(PONG, pair.robot.name, RULE, cloud.namespace)
        pair.robot.subscribe(heard_on)
        topic = build_topic(PING, pair.robot.name, "error", cloud.namespace)
        forbidden = _republishing(target, build_topic(FLEET, pair.robot.name, "error", cloud.namespace))
        told = _republishing(target, heard_on)
        with _rule(target, f"SELECT * FROM '{topic}'", forbidden, told) as name:
            body = _heard(pair, f"$aws/rules/{name}/{topic}", b'{"v": 1}').decode()
    document = json.loads(body)
    (entry,) = entries(body, lambda _: ())
    return {
        "source": entry.source.replace(name, "NAME"),
        "robot_is_the_topics": entry.robot == pair.robot.name,
        "topic_as_published": entry.topic == topic,
        "payload_as_published": entry.payload == b'{"v": 1}',
        "says_why": entry.reason != "no reason given",
        "keys": sorted(document),
        "keys_of_a_failure": sorted(document["failures"][0]),
        "topic_has_the_prefix": document["topic"] != topic,
    }


def _star(target: Target) -> dict[str, Any]:
    with pair_of(target, "verify-star") as pair:
        heard_on = build_topic(PONG, pair.robot.name, RULE, target.cloud.namespace)
        pair.robot.subscribe(heard_on)
        topic = build_topic(PING, pair.robot.name, "star", target.cloud.namespace)
        told = _republishing(target, heard_on)
        with _rule(target, f"SELECT *, topic() AS {TOPIC} FROM '{topic}'", told, told):
            body = _heard(pair, topic, json.dumps({TOPIC: "the message's", "kept": 1}).encode())
    stays = {"the message's": "the message's", topic: "the rule's"}
    members: list[tuple[str, Any]] = json.loads(body, object_pairs_hook=list)
    return {
        "other_keys_stay": ("kept", 1) in members,
        "topic_is": [stays.get(value, "another") for name, value in members if name == TOPIC],
    }


def _refused(target: Target, robot: str) -> list[Entry]:
    """What is in quarantine of the robot."""
    return list(quarantine.entries(target.cloud, robot=robot))


def _kept(target: Target, entry: Entry) -> bytes | None:
    loaded = quarantine.load(target.cloud, entry)
    return loaded.payload if loaded else None


def _live_no_json(target: Target) -> dict[str, Any]:
    with pair_of(target, "verify-live-no-json") as pair:
        robot = pair.robot.name
        pair.publish(live_topic(robot, VESC_STREAM, target.cloud.namespace), _BYTES)
        (entry,) = until(lambda: _refused(target, robot), "the message in quarantine", within_s=60)
    return {
        "refused_by": entry.source.split()[0],
        "topic_as_subscribed": entry.topic == build_topic(LIVE, robot, VESC_STREAM, target.cloud.namespace),
        "byte_by_byte": _kept(target, entry) == _BYTES,
    }


def _record_no_json(target: Target) -> dict[str, Any]:
    cloud = target.cloud
    with pair_of(target, "verify-record-no-json") as pair:
        robot = pair.robot.name
        pair.publish(record_topic(robot, VESC_STREAM, cloud.namespace), _BYTES)
        # A batch without its key: it is refused later than the other, where the other is.
        pair.publish(record_topic(robot, VESC_STREAM, cloud.namespace), b'{"v": 1}')

        def of_the_batch() -> list[Entry]:
            found = _refused(target, robot)
            return found if any(_kept(target, entry) == b'{"v": 1}' for entry in found) else []

        found = until(of_the_batch, "the batch without a key in quarantine", within_s=60)
    stored = cloud.client("dynamodb").query(
        TableName=cloud.output("storage", "TelemetryTable"),
        KeyConditionExpression=f"{TOPIC} = :topic",
        ExpressionAttributeValues={
            ":topic": {"S": build_topic(RECORD, robot, VESC_STREAM, cloud.namespace)},
        },
        Select="COUNT",
    )
    return {
        "stored": stored["Count"],
        "refused_by": sorted({entry.source.split()[0] for entry in found}),
        "no_json_is_in_quarantine": any(_kept(target, entry) == _BYTES for entry in found),
    }


def _pong_no_json(target: Target) -> dict[str, Any]:
    cloud = target.cloud
    with pair_of(target, "verify-pong-no-json") as pair:
        robot = pair.robot.name
        pair.robot.subscribe(build_topic(PONG, robot, RULE, cloud.namespace))
        topic = build_topic(PING, robot, RULE, cloud.namespace)
        pair.publish(topic, _BYTES)
        pair.publish(topic, encode_ping(7, 1))
        answers: list[dict[str, Any]] = []
        while not answers or answers[-1].get("id") != 7:
            answers.append(json.loads(pair.robot.next_message()[1]))
    return {
        "the_next_ping_is_answered": True,
        "answered_to_no_json": [sorted(answer) for answer in answers[:-1]],
    }


def _largest(target: Target) -> dict[str, Any]:
    def attempt(robot: Robot, size: int) -> str:
        topic = build_topic(FLEET, robot.name, "size", target.cloud.namespace)
        try:
            return robot.publish(topic, b"x" * size)
        except VerifyError:
            return "no answer"

    with pair_of(target, "verify-size") as pair:
        ours = attempt(pair.robot, MAX_MESSAGE_BYTES)
        exactly = attempt(pair.robot, _AWS_MESSAGE_BYTES)
        ended = pair.robot.lost.is_set()
    return {"ours": ours, "exactly_128_kib": exactly, "exactly_128_kib_ends_the_session": ended}
