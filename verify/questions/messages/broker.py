"""The broker: admission, refusals and their form, and limits per second."""

from __future__ import annotations

import concurrent.futures
import time
from typing import Any

from iort_contract.topics import CMD, FLEET, build_topic
from testkit.mqtt import CONNECT_AGAIN_S, Robot, refusal
from testkit.target import Target
from verify.question import Seen, question
from verify.tools.robots import pair_of, registered

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
