"""The live lane: from a robot to a subscriber of PubNub, with the times of the hops."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from itertools import count

from iort_contract.catalog.vesc import VESC_STREAM
from iort_contract.cloud import pubnub_parameter
from iort_contract.limits import DEFAULT_NAMESPACE
from iort_contract.messages.live import (
    VIEW_LEASE_MS,
    Lease,
    LiveSample,
    decode_lease,
    encode_live,
    lease_topic,
)
from iort_contract.tables import RECEIVED_MS
from iort_contract.topics import live_topic
from iort_station.cloud import Cloud
from iort_station.errors import StationError
from iort_station.fleet import viewing
from iort_station.page.page import PubNubKeys, load_keys, store_keys
from testkit.mqtt import Robot
from testkit.target import Target
from testkit.waiting import until
from verify.question import CannotAskError, Seen, question
from verify.tools import RUN

_STALE = 0
# Two clocks of AWS differ by less than the first, the operator's and AWS' by less than the second.
_SAME_CLOCK_US, _OTHER_CLOCK_US = 100_000, 60_000_000


def _sent(robot: Robot, target: Target, number: int, age_s: float = 0.0) -> LiveSample:
    now_us = time.time_ns() // 1000
    live = LiveSample(RUN, number, int(now_us - age_s * 1_000_000), now_us, {"speed": float(number)})
    robot.publish(live_topic(robot.name, VESC_STREAM, target.cloud.namespace), encode_live(live))
    return live


@contextmanager
def keys_lent(target: Target) -> Iterator[None]:
    """Store PubNub's keys: a deployment without its own gets those of the namespace iort."""
    cloud = target.cloud
    own = _stored(cloud)
    if own is None:
        others = _stored(replace(cloud, namespace=DEFAULT_NAMESPACE))
        if others is None:
            raise CannotAskError(f"no PubNub keys: `iort pubnub` stores them for {DEFAULT_NAMESPACE}")
        store_keys(cloud, others)
    try:
        yield
    finally:
        if own is None:
            cloud.client("ssm").delete_parameter(Name=pubnub_parameter(cloud.namespace))


def _stored(cloud: Cloud) -> PubNubKeys | None:
    try:
        return load_keys(cloud)
    except StationError:
        return None


@question(
    "live.to_subscriber",
    expected={
        "stale_heard": False,
        "robot": True,
        "stream": [VESC_STREAM],
        "hops": sorted(["sent_us", RECEIVED_MS, "lambda_us"]),
        "left_car_before_rule": True,
        "at_rule_before_lambda": True,
    },
    relied_on_by=(
        "functions/live.py",
        "functions/shared/pubnub_client.py",
        "contract/iort_contract/cloud.py",
    ),
)
def to_subscriber(target: Target) -> Seen:
    """A live sample goes by Basic Ingest to Lambda 1 and by PubNub to the subscriber of the robot's
    channel; a sample that is a minute old does not."""
    bundle = target.robot("verify-live")
    with keys_lent(target), target.listener(bundle.robot) as listener, Robot(bundle.folder) as robot:
        robot.online()
        _sent(robot, target, _STALE, age_s=60)
        numbers = count(_STALE + 1)

        def shown(more_than: int) -> bool:
            """Send one more: Lambda 1 may have to start first, and messages older than 2 s are dropped."""
            _sent(robot, target, next(numbers))
            return len(listener.heard) > more_than

        until(lambda: shown(0), "a live sample at the subscriber")
        # When a later one is there too, the stale one would have come.
        until(partial(shown, len(listener.heard)), "a later live sample at the subscriber")
        heard = list(listener.heard)
    hops = [one.hops for one in heard]
    return {
        "stale_heard": any(one.seq == _STALE for one in heard),
        "robot": {one.robot for one in heard} == {bundle.robot},
        "stream": sorted({one.stream for one in heard}),
        "hops": sorted({name for one in hops for name in one}),
        "left_car_before_rule": all(
            one["sent_us"] <= one[RECEIVED_MS] * 1000 + _OTHER_CLOCK_US for one in hops
        ),
        "at_rule_before_lambda": all(
            one[RECEIVED_MS] * 1000 <= one["lambda_us"] + _SAME_CLOCK_US for one in hops
        ),
        "note_heard": [one.seq for one in heard],
        "note_delay_ms": [round(one.delay_ms) for one in heard],
    }


@question(
    "live.lease",
    expected={"subscribed": "GRANTED_QOS_1", "heard": True, "to_another": "NOT_AUTHORIZED"},
    relied_on_by=("device/iort_agent/lanes/viewers.py", "stacks/fleet.py"),
)
def lease(target: Target) -> Seen:
    """A viewer's lease, published by the operator's HTTP request, reaches the robot, whose policy allows its
    topic by the pattern ???w*; a robot may not publish another's."""
    robot, other = target.robot("verify-looked-at"), target.name("verify-looks")
    asked = Lease("0badcafe", 10, VIEW_LEASE_MS)
    topic = lease_topic(robot.robot, target.cloud.namespace)
    with Robot(robot.folder) as car:
        subscribed = car.online().subscribe(topic)
        viewing.view(target.cloud, [robot.robot], asked)
        heard_on, payload = car.next_message()
        to_another = car.attempt(lease_topic(other, target.cloud.namespace), payload)
    return {
        "subscribed": subscribed,
        "heard": heard_on == topic and decode_lease(payload) == asked,
        "to_another": to_another,
    }
