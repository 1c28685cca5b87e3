"""The broker: admission, refusals and their form, limits, and payloads that are not JSON."""

from __future__ import annotations

import concurrent.futures
import json
import time
from typing import Any

from iort_contract.catalog.vesc import VESC_STREAM
from iort_contract.limits import MAX_MESSAGE_BYTES
from iort_contract.messages.live import encode_ping
from iort_contract.topics import CMD, FLEET, LIVE, PING, PONG, RULE, live_topic, record_topic
from iort_station.operations.quarantine import DeadLetter
from testkit.mqtt import CONNECT_AGAIN_S, Robot, refusal
from testkit.waiting import until
from verify.lab import Lab
from verify.question import Seen, question


@question(
    "broker.session_taken_over",
    aws="iot:mqtt",
    expected={"second_connects": True, "first_is_ended": True, "first_is_told": "SESSION_TAKEN_OVER"},
)
def session_taken_over(lab: Lab) -> Seen:
    """If two clients share a client id, the second is connected, and the first is disconnected with the
    reason code 0x8E, session taken over."""
    folder = lab.registered("verify-takeover").folder
    first = lab.connected(folder)
    time.sleep(CONNECT_AGAIN_S)
    lab.connected(folder)
    ended = first.lost.wait(30)
    return {"second_connects": True, "first_is_ended": ended, "first_is_told": first.reason}


@question(
    "broker.another_client_id",
    aws="iot:thing-policy-variables",
    expected={"neighbours": True, "one_that_nobody_has": True},
)
def another_client_id(lab: Lab) -> Seen:
    """A robot's certificate can connect only with the robot's own name as client id."""
    bundle = lab.registered("verify-client-id")
    names = (lab.registered().robot, f"{bundle.robot}-2")
    codes = [refusal(bundle.folder, client_id=name) for name in names]
    neighbours, unknown = (code is not None for code in codes)
    return {"neighbours": neighbours, "one_that_nobody_has": unknown, "note_codes": codes}


@question(
    "broker.foreign_topic",
    aws="iot:mqtt",
    expected={"subscribe": "NOT_AUTHORIZED", "publish_is_refused": True, "neighbour_heard": 0},
)
def foreign_topic(lab: Lab) -> Seen:
    """A robot's message to its neighbour's commands does not reach the neighbour. AWS has two answers, a
    PUBACK with 0x87 or the session's end, and does not document which one comes. A subscription is refused
    by itself."""
    pair, neighbour = lab.pair("verify-foreign"), lab.connected(lab.registered().folder)
    foreign, last = (lab.topic(CMD, pair.victim, name) for name in ("drive", "last"))
    for topic in (foreign, last):
        neighbour.subscribe(topic)
    subscribed, published = pair.robot.subscribe(foreign), pair.robot.attempt(foreign, b"{}")
    lab.client("iot-data").publish(topic=last, qos=1, payload=b"{}")
    heard = [neighbour.next_message()[0]]
    while heard[-1] != last:
        heard.append(neighbour.next_message()[0])
    return {
        "subscribe": subscribed,
        "publish_is_refused": published != "SUCCESS",
        "neighbour_heard": len(heard) - 1,
        "note_publish": published,
    }


_BURST_S, _ACKNOWLEDGED_S = 2, 10.0


def _burst(robot: Robot, topic: str, per_s: int) -> dict[str, Any]:
    """The answers to this many messages a second."""
    began, sent = time.monotonic(), []
    for number in range(_BURST_S * per_s):
        # The pace is the question.
        time.sleep(max(0.0, began + number / per_s - time.monotonic()))
        sent.append(robot.send(topic, b"{}"))
    done, waiting = concurrent.futures.wait(sent, timeout=_ACKNOWLEDGED_S)
    codes = {
        "an error of the library" if answer.exception() else str(answer.result().puback.reason_code.name)
        for answer in done
    }
    return {"answers": sorted(codes), "unanswered": bool(waiting), "session_ended": robot.lost.is_set()}


@question(
    "broker.publishes_a_second",
    aws="quotas:iot-core",
    expected={"at_90_a_second": {"answers": ["SUCCESS"], "unanswered": False, "session_ended": False}},
)
def publishes_a_second(lab: Lab) -> Seen:
    """A connection may publish 90 times a second, the agent's share of AWS' 100. AWS discards messages
    beyond 100; the agent never sends them."""
    robot = lab.connected(lab.registered("verify-rate").folder, paced=False)
    topic = lab.topic(FLEET, robot.name, "rate")
    ours = _burst(robot, topic, 90)
    beyond = {f"note_at_{per_s}_a_second": _burst(robot, topic, per_s) for per_s in (100, 150)}
    return {"at_90_a_second": ours, **beyond}


# Neither JSON nor UTF-8.
_BYTES, _WITHOUT_KEY = b"\xff\x00 no JSON", b'{"v": 1}'
_AWS_MESSAGE_BYTES = 128 * 1024


@question(
    "payloads.live_no_json",
    aws="iot:binary-payloads",
    expected={"refused_by": "function", "topic_as_subscribed": True, "byte_by_byte": True},
)
def live_no_json(lab: Lab) -> Seen:
    """encode(*, 'base64') accepts a payload that is not JSON. Lambda 1 refuses it, and the quarantine has
    it byte by byte."""
    pair = lab.pair("verify-live-no-json")
    pair.publish(live_topic(pair.robot.name, VESC_STREAM, lab.namespace), _BYTES)
    entry = lab.only_entry(pair.robot.name)
    return {
        "refused_by": entry.source.split()[0],
        "topic_as_subscribed": entry.topic == pair.topic(LIVE),
        "byte_by_byte": entry.payload == _BYTES,
    }


@question(
    "payloads.record_no_json",
    expected={"stored": 0, "refused_by": ["rule"]},
)
def record_no_json(lab: Lab) -> Seen:
    """The rule record stores nothing from a payload that is not JSON, or from a batch without a key. The
    batch is in quarantine. AWS does not document if the other one is: see alarm ParseError."""
    pair = lab.pair("verify-record-no-json")
    robot = pair.robot.name
    # A batch without its key is refused later than the other payload.
    for payload in (_BYTES, _WITHOUT_KEY):
        pair.publish(record_topic(robot, VESC_STREAM, lab.namespace), payload)

    def with_the_batch() -> list[DeadLetter]:
        entries = lab.entries(robot)
        return entries if any(entry.payload == _WITHOUT_KEY for entry in entries) else []

    entries = until(with_the_batch, "the batch without a key in quarantine", within_s=60)
    return {
        "stored": len(lab.items(robot)),
        "refused_by": sorted({entry.source.split()[0] for entry in entries}),
        "note_no_json_is_in_quarantine": any(entry.payload == _BYTES for entry in entries),
    }


@question(
    "payloads.pong_no_json",
    expected={"the_next_ping_is_answered": True},
)
def pong_no_json(lab: Lab) -> Seen:
    """A ping that is not JSON does not affect the next one. AWS does not document if the rule pong answers
    it, without the ping's fields."""
    pair = lab.pair("verify-pong-no-json")
    pair.robot.subscribe(pair.topic(PONG, RULE))
    for payload in (_BYTES, encode_ping(7, 1)):
        pair.publish(pair.topic(PING, RULE), payload)
    answers: list[dict[str, Any]] = []
    while not answers or answers[-1].get("id") != 7:
        answers.append(json.loads(pair.robot.next_message()[1]))
    others = [sorted(answer) for answer in answers[:-1]]
    return {"the_next_ping_is_answered": True, "note_answered_to_no_json": others}


@question(
    "payloads.largest_message",
    aws="quotas:iot-core iot:mqtt",
    expected={"ours": "SUCCESS"},
)
def largest_message(lab: Lab) -> Seen:
    """A message of 127 KiB is accepted. AWS accepts payloads of 128 KB, and an MQTT 5 client counts topic
    and header too."""
    pair = lab.pair("verify-size")
    ours, exactly = (
        pair.robot.attempt(pair.topic(FLEET, "size"), b"x" * size)
        for size in (MAX_MESSAGE_BYTES, _AWS_MESSAGE_BYTES)
    )
    return {"ours": ours, "note_exactly_128_kib": exactly}
