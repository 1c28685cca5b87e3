"""The live lane by both ways to whoever looks, each on a cloud deployed for it, with enforcement on."""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable, Iterator
from datetime import datetime, timedelta, timezone
from pathlib import Path
from typing import Any

import pytest

from iort_contract.catalog.metrics import METRIC_DEPLOYMENT, METRIC_FUNCTION, METRIC_NAMESPACE, metrics_of
from iort_contract.catalog.streams import RTT_STREAM
from iort_contract.catalog.vesc import VESC_STREAM
from iort_contract.cloud import IOT, PUBNUB
from iort_contract.messages.live import LiveSample, encode_live
from iort_contract.topics import LIVE, build_topic
from iort_station.fleet import registry, robots
from iort_station.fleet.broker import Broker
from iort_station.fleet.roles import Role
from iort_station.fleet.viewing import Viewer
from iort_station.operations import audit
from iort_station.page.listening import listening
from local.cloud import EmbeddedCloud
from local.figures import round_trips
from testkit.mqtt import Robot
from testkit.waiting import until
from tests.local.data.drives import Agent
from verify.preflight.deployed import transport

_FULL_MS, _IDLE_MS = 100, 10_000


@pytest.fixture(scope="module", params=[PUBNUB, IOT])
def cloud(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[EmbeddedCloud]:
    if request.param == PUBNUB:
        yield request.getfixturevalue("embedded")
        return
    with EmbeddedCloud(tmp_path_factory.mktemp("iot") / "local", live=request.param) as own:
        yield own


@pytest.fixture
def car(cloud: EmbeddedCloud, tmp_path: Path, request: pytest.FixtureRequest) -> Callable[..., robots.Bundle]:
    """Register the test's robot: `car(sources=[...])`."""
    name = request.node.originalname.replace("test_", "")[:40]
    return lambda **settings: robots.add(cloud.cloud, f"{name}-{cloud.live}", out=tmp_path, settings=settings)


def test_the_deployment_says_its_way(cloud):
    assert transport(cloud.cloud, cloud.namespace) == cloud.live
    names = {rule["ruleName"] for rule in cloud.cloud.client("iot").list_topic_rules()["rules"]}
    assert ("iort_live" in names) == (cloud.live == PUBNUB)


def trips(cloud, robot):
    return round_trips(audit.batches(cloud.cloud, robot, RTT_STREAM))


def test_a_simulated_drive_arrives_completely_on_both_lanes(cloud, car):
    driven_car = car(
        sources=[{"type": "sim", "stream": "vesc", "rate_hz": 50}],
        ping={"rate_hz": 5, "padding_bytes": 430},
        live={"when": "always", "transport": cloud.live},
    )
    with listening(cloud.cloud, cloud.live, robot=driven_car.robot) as listener:
        agent = Agent(driven_car)
        # On a slow machine, messages that are sent while Lambda 1 starts are stale. An idle car would send so
        # many in minutes.
        until(lambda: len(listener.heard) > 10)
        until(lambda: all(one.n for one in trips(cloud, driven_car.robot).values()), "an answer on each way")
        agent.stop()
        driven = agent.report()["streams"]["vesc"]["samples"]
    until(lambda: audit.samples_summarized(cloud.cloud, driven_car.robot, "vesc") == driven)
    found = audit.delivery(cloud.cloud, driven_car.robot, "vesc")
    assert (found.samples_stored, found.batches_missing) == (driven, 0)
    assert {heard.robot for heard in listener.heard} == {driven_car.robot}
    found_trips = trips(cloud, driven_car.robot)
    assert all(spread.p50 is not None for spread in found_trips.values()), found_trips


def test_a_lease_wakes_a_car_and_its_end_lets_it_sleep(cloud, car):
    source = {"type": "sim", "stream": VESC_STREAM, "rate_hz": 50, "pose": {"rate_hz": 0}}
    asleep, heard = car(sources=[source]), list[dict[str, Any]]()

    def periods() -> list[int]:
        return [update["next_ms"] for update in list(heard)]

    def take(update: dict[str, Any], *_: int) -> None:
        # One that a later message has overtaken in the cloud is skipped, as on the page.
        if update["stream"] == VESC_STREAM and (not heard or update["seq"] > heard[-1]["seq"]):
            heard.append(update)

    with listening(cloud.cloud, cloud.live, robot=asleep.robot, on_update=take), Agent(asleep) as agent:
        until(heard.__len__)
        assert set(periods()) == {_IDLE_MS}
        with Viewer(cloud.cloud, [asleep.robot], broker=cloud.live == IOT):
            until(lambda: periods().count(_FULL_MS) >= 20)
        until(lambda: periods()[-1] == _IDLE_MS)
        count = len(heard)
        assert agent.told()["lanes"]["live"]["viewers"] == 0
        until(lambda: len(heard) > count)
        assert periods()[count:] == [_IDLE_MS]


def test_a_live_message_without_an_envelope_is_never_shown(cloud, car):
    sender = car()
    live = build_topic(LIVE, sender.robot, "vesc", cloud.namespace)
    seqs = itertools.count(7)
    with (
        listening(cloud.cloud, cloud.live, robot=sender.robot) as listener,
        Robot(sender.folder) as robot,
    ):
        robot.online()
        robot.publish(live, b'{"speed": 99}')

        def shown() -> bool:
            # On a slow machine a message may become stale before it is shown.
            now_us = time.time_ns() // 1000
            good = LiveSample("0badcafe", next(seqs), now_us, now_us, {"speed": 3})
            robot.publish(live, encode_live(good))
            return bool(listener.heard)

        until(shown)
    assert {heard.boot for heard in listener.heard} == {"0badcafe"}
    assert min(heard.seq for heard in listener.heard) >= 7


def test_who_looks_is_nothing_to_the_registry(cloud, car):
    """The function presence is called for the robot alone, and ignores nobody."""
    robot = car()
    before = _presence(cloud)
    for _ in range(3):
        with Broker(cloud.cloud, Role(cloud.cloud), filters=[f"{LIVE}/{cloud.namespace}/+/+"]):
            pass
    with Robot(robot.folder) as connected:
        connected.online()
        until(lambda: registry.presence(cloud.cloud)[robot.robot]["online"])
    until(lambda: not registry.presence(cloud.cloud)[robot.robot]["online"])
    until(lambda: _presence(cloud)["RobotsDisconnected"] > before["RobotsDisconnected"])
    assert _presence(cloud)["PresenceIgnored"] == before["PresenceIgnored"]


def _presence(cloud: EmbeddedCloud) -> dict[str, float]:
    """The sums of the function's metrics."""
    dimensions = {METRIC_DEPLOYMENT: cloud.namespace, METRIC_FUNCTION: "presence"}
    now = datetime.now(timezone.utc)
    return {
        name: sum(
            point["Sum"]
            for point in cloud.cloud.client("cloudwatch").get_metric_statistics(
                Namespace=METRIC_NAMESPACE,
                MetricName=name,
                Dimensions=[{"Name": key, "Value": value} for key, value in dimensions.items()],
                StartTime=now - timedelta(hours=3),
                EndTime=now + timedelta(minutes=1),
                Period=60,
                Statistics=["Sum"],
            )["Datapoints"]
        )
        for name in metrics_of("presence")
    }
