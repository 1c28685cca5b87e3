"""The topic rules: what they make of a message that says what only the cloud may say."""

from __future__ import annotations

import time
from typing import Any

from bench.target import Target
from contract import (
    EXPIRES_S,
    RECEIVED_MS,
    RECORD,
    TOPIC,
    VESC_STREAM,
    Batch,
    build_topic,
    encode,
    record_topic,
)
from verify.assumption import Basis
from verify.check import Check
from verify.robot import Robot
from verify.spoofing import spoofed
from verify.waiting import until

_SQL = "https://docs.aws.amazon.com/iot/latest/developerguide/iot-sql-select.html"
_DYNAMODB_V2 = "https://docs.aws.amazon.com/iot/latest/developerguide/dynamodb-v2-rule-action.html"
_RUN = "0badcafe"
# A batch without `nonfinite`, as DynamoDB types it.
_STORED = {
    "v": "N",
    "batch": "S",
    "codec": "S",
    "n": "N",
    "samples": "S",
    TOPIC: "S",
    RECEIVED_MS: "N",
    EXPIRES_S: "N",
}


def _items(target: Target, robot: str) -> list[dict[str, Any]]:
    """The robot's telemetry as DynamoDB has it, types included."""
    topic = build_topic(RECORD, robot, VESC_STREAM, target.cloud.namespace)
    answer = target.cloud.client("dynamodb").query(
        TableName=target.cloud.output("storage", "TelemetryTable"),
        KeyConditionExpression="topic = :topic",
        ExpressionAttributeValues={":topic": {"S": topic}},
    )
    return list(answer["Items"])


def _spoofed_record(target: Target) -> dict[str, Any]:
    bundle, victim = target.robot("verify-spoofing"), target.robot("verify-victim").robot
    message = encode(Batch(_RUN, 0, [int(time.time()) * 1_000_000], {"speed": [1.5]}))
    with Robot(bundle.folder) as robot:
        robot.online()
        topic = record_topic(robot.name, VESC_STREAM, target.cloud.namespace)
        robot.publish(topic, spoofed(message, victim, RECORD, VESC_STREAM, target.cloud.namespace))
        (item,) = until(lambda: _items(target, robot.name), "the batch in the telemetry table")
    now_s = time.time()
    return {
        "own_partition": 1,
        "victims_partition": len(_items(target, victim)),
        "keys": sorted(item),
        "received_by_the_clouds_clock": abs(int(item[RECEIVED_MS]["N"]) / 1000 - now_s) < 3600,
        "expires_by_the_clouds_clock": abs(int(item[EXPIRES_S]["N"]) - now_s) < 4000 * 86_400,
        "types": {name: next(iter(value)) for name, value in sorted(item.items())},
    }


CHECKS = (
    Check(
        name="rules.record_spoofed",
        assumed=(
            "The rule record stores the keys of a batch and the cloud's three, each by name. A key of the "
            "message with the name of one of the cloud's is not stored. A key that the message lacks is "
            "absent. A text becomes S, a number N."
        ),
        expected={
            "own_partition": 1,
            "victims_partition": 0,
            "keys": sorted(_STORED),
            "received_by_the_clouds_clock": True,
            "expires_by_the_clouds_clock": True,
            "types": dict(sorted(_STORED.items())),
        },
        basis=Basis.DOCUMENTED,
        source=f"{_SQL} and {_DYNAMODB_V2}",
        relied_on_by=("contract/cloud.py", "functions/stored.py"),
        ask=_spoofed_record,
    ),
)
