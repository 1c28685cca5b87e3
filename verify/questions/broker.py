"""The broker: admission, refusals and their form, limits, and payloads that are not JSON."""

from __future__ import annotations

import concurrent.futures
import json
import time
from typing import Any

from iort_contract.catalog.vesc import VESC_STREAM
from iort_contract.limits import MAX_MESSAGE_BYTES
from iort_contract.messages.live import encode_ping
from iort_contract.topics import CMD, FLEET, LIVE, PING, PONG, RULE, build_topic, live_topic, record_topic
from iort_station.operations.quarantine import DeadLetter
from testkit.mqtt import CONNECT_AGAIN_S, Robot, refusal
from testkit.target import Target
from testkit.waiting import until
from verify.question import Seen, question
from verify.tools import entries, items, only_entry, pair_of, registered

_MQTT = "https://docs.aws.amazon.com/iot/latest/developerguide/mqtt.html"
_QUOTAS = "https://docs.aws.amazon.com/general/latest/gr/iot-core.html"
_BURST_S, _ACKNOWLEDGED_S = 2, 10.0


@question(
    "broker.session_taken_over",
    expected={"second_connects": True, "first_is_ended": True, "first_is_told": "SESSION_TAKEN_OVER"},
    source=_MQTT,
    relied_on_by=("device/iort_agent/mqtt/aws.py",),
)
def session_taken_over(target: Target) -> Seen:
    """If two clients share a client id, the second is connected, and the first is disconnected with the
    reason code 0x8E, session taken over."""
    folder = registered(target, "verify-takeover").folder
    with Robot(folder) as first:
        first.online()
        time.sleep(CONNECT_AGAIN_S)
        with Robot(folder) as second:
            second.online()
            ended = first.lost.wait(30)
            return {"second_connects": True, "first_is_ended": ended, "first_is_told": first.reason}


@question(
    "broker.another_client_id",
    expected={"neighbours": True, "one_that_nobody_has": True},
    source="https://docs.aws.amazon.com/iot/latest/developerguide/thing-policy-variables.html",
    relied_on_by=("stacks/fleet.py", "device/iort_agent/mqtt/failures.py"),
)
def another_client_id(target: Target) -> Seen:
    """A robot's certificate can connect only with the robot's own name as client id."""
    bundle, victim = registered(target, "verify-client-id"), registered(target, "verify-victim").robot
    codes = [refusal(bundle.folder, client_id=name) for name in (victim, f"{bundle.robot}-2")]
    return {
        "neighbours": codes[0] is not None,
        "one_that_nobody_has": codes[1] is not None,
        "note_codes": codes,
    }


@question(
    "broker.foreign_topic",
    expected={"subscribe": "NOT_AUTHORIZED", "publish_is_refused": True, "neighbour_heard": 0},
    source=_MQTT,
    relied_on_by=("stacks/fleet.py", "device/iort_agent/mqtt/dispatch.py"),
)
def foreign_topic(target: Target) -> Seen:
    """A robot's message to its neighbour's commands does not reach the neighbour. AWS has two answers, a
    PUBACK with 0x87 or the session's end, and does not document which one comes. A subscription is refused
    by itself."""
    namespace, victim = target.cloud.namespace, registered(target, "verify-victim")
    foreign, last = (build_topic(CMD, victim.robot, name, namespace) for name in ("drive", "last"))
    with pair_of(target, "verify-foreign") as pair, Robot(victim.folder) as neighbour:
        for topic in (foreign, last):
            neighbour.online().subscribe(topic)
        subscribed = pair.robot.subscribe(foreign)
        published = pair.robot.attempt(foreign, b"{}")
        target.cloud.client("iot-data").publish(topic=last, qos=1, payload=b"{}")
        heard = [neighbour.next_message()[0]]
        while heard[-1] != last:
            heard.append(neighbour.next_message()[0])
    return {
        "subscribe": subscribed,
        "publish_is_refused": published != "SUCCESS",
        "neighbour_heard": len(heard) - 1,
        "note_publish": published,
    }


_ALL_TAKEN = {"answers": ["SUCCESS"], "unanswered": False, "session_ended": False}


def _burst(robot: Robot, topic: str, per_s: int) -> dict[str, Any]:
    """The answers to this many messages a second."""
    began, sent = time.monotonic(), []
    for number in range(_BURST_S * per_s):
        # The pace is the question.
        time.sleep(max(0.0, began + number / per_s - time.monotonic()))
        sent.append(robot.send(topic, b"{}"))
    done, waiting = concurrent.futures.wait(sent, timeout=_ACKNOWLEDGED_S)
    codes = {
        "an error of the library" if one.exception() else str(one.result().puback.reason_code.name)
        for one in done
    }
    return {"answers": sorted(codes), "unanswered": bool(waiting), "session_ended": robot.lost.is_set()}


@question(
    "broker.publishes_a_second",
    expected={"at_90_a_second": _ALL_TAKEN},
    source=_QUOTAS,
    relied_on_by=("device/iort_agent/mqtt/rate_limiter.py",),
)
def publishes_a_second(target: Target) -> Seen:
    """A connection may publish 90 times a second, the agent's share of AWS' 100. AWS discards messages
    beyond 100; the agent never sends them."""
    with Robot(registered(target, "verify-rate").folder, paced=False) as robot:
        topic = build_topic(FLEET, robot.online().name, "rate", target.cloud.namespace)
        ours = _burst(robot, topic, 90)
        beyond = {f"note_at_{per_s}_a_second": _burst(robot, topic, per_s) for per_s in (100, 150)}
        return {"at_90_a_second": ours, **beyond}


_GUIDE = "https://docs.aws.amazon.com/iot/latest/developerguide"
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
