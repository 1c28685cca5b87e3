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
from testkit.target import Target
from testkit.waiting import until
from verify.lab import RUN, CannotAskError, Lab
from verify.question import Seen, question

_STALE = 0
# Two clocks of AWS differ by less than the first, the operator's and AWS' by less than the second.
_SAME_CLOCK_US, _OTHER_CLOCK_US = 100_000, 60_000_000


@contextmanager
def keys_lent(target: Target) -> Iterator[None]:
    """Store PubNub's keys: a deployment without its own gets those of the namespace iort."""
    cloud = target.cloud
    if _keys(cloud) is not None:
        yield
        return
    others = _keys(replace(cloud, namespace=DEFAULT_NAMESPACE))
    if others is None:
        raise CannotAskError(f"no PubNub keys: `iort pubnub` stores them for {DEFAULT_NAMESPACE}")
    store_keys(cloud, others)
    try:
        yield
    finally:
        cloud.client("ssm").delete_parameter(Name=pubnub_parameter(cloud.namespace))


def _keys(cloud: Cloud) -> PubNubKeys | None:
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
)
def to_subscriber(lab: Lab) -> Seen:
    """A live sample goes by Basic Ingest to Lambda 1 and by PubNub to the subscriber of the robot's
    channel; a sample that is a minute old does not."""
    bundle = lab.robot("verify-live")
    lab.enter(keys_lent(lab.target))
    listener, robot = lab.enter(lab.target.listener(bundle.robot)), lab.connected(bundle.folder)

    def send(number: int, age_s: int = 0) -> None:
        now_us = time.time_ns() // 1000
        sample = LiveSample(RUN, number, now_us - age_s * 1_000_000, now_us, {"speed": float(number)})
        robot.publish(live_topic(robot.name, VESC_STREAM, lab.namespace), encode_live(sample))

    send(_STALE, age_s=60)
    numbers = count(_STALE + 1)

    def shown(more_than: int) -> bool:
        """Send one more: Lambda 1 may have to start first, and messages older than 2 s are dropped."""
        send(next(numbers))
        return len(listener.heard) > more_than

    until(lambda: shown(0), "a live sample at the subscriber")
    # When a later one is there too, the stale one would have come.
    until(partial(shown, len(listener.heard)), "a later live sample at the subscriber")
    heard = list(listener.heard)
    hops = [(each.hops["sent_us"], each.hops[RECEIVED_MS] * 1000, each.hops["lambda_us"]) for each in heard]
    return {
        "stale_heard": any(each.seq == _STALE for each in heard),
        "robot": {each.robot for each in heard} == {bundle.robot},
        "stream": sorted({each.stream for each in heard}),
        "hops": sorted({name for each in heard for name in each.hops}),
        "left_car_before_rule": all(sent <= rule + _OTHER_CLOCK_US for sent, rule, _ in hops),
        "at_rule_before_lambda": all(rule <= function + _SAME_CLOCK_US for _, rule, function in hops),
        "note_heard": [each.seq for each in heard],
        "note_delay_ms": [round(each.delay_ms) for each in heard],
    }


@question(
    "live.lease",
    expected={"subscribed": "GRANTED_QOS_1", "heard": True, "to_another": "NOT_AUTHORIZED"},
)
def lease(lab: Lab) -> Seen:
    """A viewer's lease, published by the operator's HTTP request, reaches the robot, whose policy allows its
    topic by the pattern ???w*; a robot may not publish another's."""
    car, request = lab.connected(lab.robot("verify-looked-at").folder), Lease(RUN, 10, VIEW_LEASE_MS)
    topic = lease_topic(car.name, lab.namespace)
    subscribed = car.subscribe(topic)
    viewing.view(lab.cloud, [car.name], request)
    heard_on, payload = car.next_message()
    to_another = car.attempt(lease_topic(lab.name("verify-looks"), lab.namespace), payload)
    heard = heard_on == topic and decode_lease(payload) == request
    return {"subscribed": subscribed, "heard": heard, "to_another": to_another}
