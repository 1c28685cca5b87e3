"""A robot's batches: sent, in the telemetry table, in the quarantine."""

from __future__ import annotations

import json
import time
from typing import Any

from iort_contract.catalog.vesc import VESC_STREAM
from iort_contract.messages.batch import Batch, encode_batch
from iort_contract.tables import STREAMS
from iort_contract.topics import RECORD, build_topic, record_topic
from iort_station.fleet import registry
from iort_station.fleet.robots import Bundle
from iort_station.operations import quarantine
from iort_station.operations.quarantine import DeadLetter
from testkit.mqtt import Robot
from testkit.target import Target
from testkit.waiting import InstrumentError, until

RUN = "0badcafe"


def batch(number: int = 0, *, first_us: int = 0, **changes: Any) -> bytes:
    """A batch with one sample, of now or of ``first_us``; ``changes`` replace members of its envelope."""
    first_us = first_us or (int(time.time()) - 5) * 1_000_000
    made = Batch(RUN, number, [first_us + number * 1_000_000], {"speed": [1.5]})
    return json.dumps({**json.loads(encode_batch(made)), **changes}).encode()


def send(target: Target, bundle: Bundle, *messages: bytes) -> None:
    """Connect as the robot of a bundle, and publish on its record lane."""
    with Robot(bundle.folder) as robot:
        robot.online()
        for message in messages:
            robot.publish(record_topic(robot.name, VESC_STREAM, target.cloud.namespace), message)


def topic(target: Target, robot: str) -> str:
    """The partition of the robot's batches."""
    return build_topic(RECORD, robot, VESC_STREAM, target.cloud.namespace)


def items(target: Target, robot: str) -> list[dict[str, Any]]:
    """The robot's batches as stored in DynamoDB, types included."""
    answer = target.cloud.client("dynamodb").query(
        TableName=target.cloud.output("storage", "TelemetryTable"),
        KeyConditionExpression="topic = :topic",
        ExpressionAttributeValues={":topic": {"S": topic(target, robot)}},
    )
    return list(answer["Items"])


def stored(target: Target, robot: str, batches: int) -> None:
    """Wait until the table has so many of the robot's batches, and its row names their stream."""
    until(lambda: len(items(target, robot)) == batches, "the batches in the telemetry table")
    until(
        lambda: VESC_STREAM in (registry.find(target.cloud, robot) or {}).get(STREAMS, ()),
        "the batches' stream in the robot's row",
    )


def listed(target: Target, robot: str) -> list[DeadLetter]:
    """The robot's entries in the quarantine, without their messages."""
    return list(quarantine.entries(target.cloud, robot=robot))


def entries(target: Target, robot: str) -> list[DeadLetter]:
    """The robot's entries in the quarantine, with their messages."""
    return [entry for one in listed(target, robot) if (entry := quarantine.load(target.cloud, one))]


def only_entry(target: Target, robot: str, *, within_s: float = 90.0) -> DeadLetter:
    """Wait for the robot's entry in the quarantine; raises `InstrumentError` unless it is the only one."""
    found = until(lambda: entries(target, robot), "the entry in the quarantine", within_s=within_s)
    if len(found) != 1:
        raise InstrumentError(f"the quarantine must have one entry of {robot}, got {len(found)}")
    return found[0]
