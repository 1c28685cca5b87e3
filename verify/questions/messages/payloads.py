"""The topic rules with payloads that are not JSON, and the size limit of a payload."""

from __future__ import annotations

import json
from typing import Any

from iort_contract.catalog.vesc import VESC_STREAM
from iort_contract.limits import MAX_MESSAGE_BYTES
from iort_contract.messages.live import encode_ping
from iort_contract.topics import FLEET, LIVE, PING, PONG, RULE, build_topic, live_topic, record_topic
from iort_station.operations.quarantine import DeadLetter
from testkit.target import Target
from testkit.waiting import until
from verify.question import Seen, question
from verify.tools.robots import pair_of
from verify.tools.telemetry import entries, items, only_entry

_GUIDE = "https://docs.aws.amazon.com/iot/latest/developerguide"
_QUOTAS = "https://docs.aws.amazon.com/general/latest/gr/iot-core.html"
# Neither JSON nor UTF-8.
_BYTES = b"\xff\x00 no JSON"
_AWS_MESSAGE_BYTES = 128 * 1024


@question(
    "payloads.live_no_json",
    expected={"refused_by": "function", "topic_as_subscribed": True, "byte_by_byte": True},
    source=f"{_GUIDE}/binary-payloads.html",
    relied_on_by=(
        "contract/iort_contract/catalog/rules.py",
        "functions/live.py",
        "local/patches/unreadable_payload.patch",
    ),
)
def live_no_json(target: Target) -> Seen:
    """encode(*, 'base64') accepts a payload that is not JSON. Lambda 1 refuses it, and the quarantine has
    it byte by byte."""
    with pair_of(target, "verify-live-no-json") as pair:
        robot = pair.robot.name
        pair.publish(live_topic(robot, VESC_STREAM, target.cloud.namespace), _BYTES)
        entry = only_entry(target, robot)
    return {
        "refused_by": entry.source.split()[0],
        "topic_as_subscribed": entry.topic == build_topic(LIVE, robot, VESC_STREAM, target.cloud.namespace),
        "byte_by_byte": entry.payload == _BYTES,
    }


@question(
    "payloads.record_no_json",
    expected={"stored": 0, "refused_by": ["rule"]},
    relied_on_by=("stacks/ingest.py", "stacks/monitoring.py"),
)
def record_no_json(target: Target) -> Seen:
    """The rule record stores nothing from a payload that is not JSON, or from a batch without a key. The
    batch is in quarantine. AWS does not document if the other one is: see alarm ParseError."""
    cloud = target.cloud
    with pair_of(target, "verify-record-no-json") as pair:
        robot = pair.robot.name
        pair.publish(record_topic(robot, VESC_STREAM, cloud.namespace), _BYTES)
        # A batch without its key is refused later than the other payload.
        pair.publish(record_topic(robot, VESC_STREAM, cloud.namespace), b'{"v": 1}')

        def of_the_batch() -> list[DeadLetter]:
            found = entries(target, robot)
            return found if any(entry.payload == b'{"v": 1}' for entry in found) else []

        found = until(of_the_batch, "the batch without a key in quarantine", within_s=60)
    return {
        "stored": len(items(target, robot)),
        "refused_by": sorted({entry.source.split()[0] for entry in found}),
        "note_no_json_is_in_quarantine": any(entry.payload == _BYTES for entry in found),
    }


@question(
    "payloads.pong_no_json",
    expected={"the_next_ping_is_answered": True},
    relied_on_by=("device/iort_agent/lanes/pings.py",),
)
def pong_no_json(target: Target) -> Seen:
    """A ping that is not JSON does not affect the next one. AWS does not document if the rule pong answers
    it, without the ping's fields."""
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
        "note_answered_to_no_json": [sorted(answer) for answer in answers[:-1]],
    }


@question(
    "payloads.largest_message",
    expected={"ours": "SUCCESS"},
    source=f"{_QUOTAS} and {_GUIDE}/mqtt.html",
    relied_on_by=("contract/iort_contract/limits.py", "local/patches/message_size.patch"),
)
def largest_message(target: Target) -> Seen:
    """A message of 127 KiB is accepted. AWS accepts payloads of 128 KB, and an MQTT 5 client counts topic
    and header too."""
    with pair_of(target, "verify-size") as pair:
        topic = build_topic(FLEET, pair.robot.name, "size", target.cloud.namespace)
        ours, exactly = (
            pair.robot.attempt(topic, b"x" * size) for size in (MAX_MESSAGE_BYTES, _AWS_MESSAGE_BYTES)
        )
    return {"ours": ours, "note_exactly_128_kib": exactly}
