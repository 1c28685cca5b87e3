"""A viewer holds its leases while it looks, and ends them."""

from __future__ import annotations

import threading
import time
from collections import defaultdict
from dataclasses import replace
from typing import Any

import pytest
from botocore.exceptions import ClientError

from iort_contract.messages.live import LiveSample, live_update
from iort_contract.messages.viewing import VIEW_LEASE_MS, Lease, decode_lease, lease_topic
from iort_contract.topics import parse_topic
from iort_station.errors import StationError
from iort_station.fleet import viewing
from iort_station.page.live import GONE_S, STALE_S, FleetWatch

LEASE = Lease("0badcafe", 10, VIEW_LEASE_MS)


class Cloud:
    """Keeps the leases that are published, by robot."""

    namespace = "iort"

    def __init__(self, *, refuses: bool = False) -> None:
        self.refuses = refuses
        self.heard: dict[str, list[Lease]] = defaultdict(list)
        self.renewed = threading.Semaphore(0)

    def client(self, service: str) -> Cloud:
        assert service == "iot-data"
        return self

    def publish(self, *, topic: str, qos: int, payload: bytes) -> None:
        if self.refuses:
            raise ClientError({"Error": {"Code": "ForbiddenException", "Message": "no"}}, "Publish")
        assert qos == 0
        robot = parse_topic(topic).robot
        assert topic == lease_topic(robot, "iort")
        self.heard[robot].append(decode_lease(payload))
        self.renewed.release()


def test_a_viewer_renews_its_leases_and_ends_them() -> None:
    cloud: Any = Cloud()
    with viewing.Viewer(cloud, ["a", "b"], rate_hz=2, broker=True, every_s=0.01) as viewer:
        assert set(cloud.heard) == {"a", "b"}, "awake at once"
        for _ in range(6):
            assert cloud.renewed.acquire(timeout=10)
    assert viewer.problem == ""
    for leases in cloud.heard.values():
        *held, ended = leases
        assert len(held) >= 3
        assert {(one.viewer, one.rate_hz, one.lease_ms, one.broker) for one in held} == {
            (ended.viewer, 2, VIEW_LEASE_MS, True)
        }
        assert ended.lease_ms == 0


def test_a_robot_that_comes_is_woken_and_one_that_goes_is_let_go() -> None:
    cloud: Any = Cloud()
    online = ["a"]
    with viewing.Viewer(cloud, lambda: online, every_s=0.01):
        online[:] = ["b"]
        while not cloud.heard["b"]:
            assert cloud.renewed.acquire(timeout=10)
    assert cloud.heard["a"][-1].lease_ms == 0


def test_a_viewer_whose_network_is_gone_ends_soon(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(viewing, "_GOODBYE_S", 0.1)
    cloud: Any = Cloud()
    asked, network = threading.Semaphore(0), threading.Event()

    def robots() -> list[str]:
        asked.release()
        # The second time it hangs.
        assert not cloud.heard or network.wait(60)
        return ["a"]

    viewer = viewing.Viewer(cloud, robots, every_s=0.01)
    with viewer:
        assert asked.acquire(timeout=10)
        assert asked.acquire(timeout=10)
        began = time.monotonic()
    assert time.monotonic() - began < 30, "it did not wait for the network"
    network.set()
    viewer._thread.join(10)


def test_who_may_not_wake_robots_is_told_and_looks_on() -> None:
    cloud: Any = Cloud(refuses=True)
    with viewing.Viewer(cloud, ["a"]) as viewer:
        assert "cannot be woken" in viewer.problem
    with pytest.raises(StationError, match="cannot be woken"):
        viewing.view(cloud, ["a"], LEASE)
    assert viewing.view(cloud, [], LEASE) == 0


def test_a_car_that_nobody_holds_awake_is_online_until_its_next_message_is_due() -> None:
    live = LiveSample("0badcafe", 0, 1_000_000, 1_000_000, {"speed": 1})
    fleet = FleetWatch({})
    fleet.take(live_update("idle", "vesc", replace(live, next_ms=10_000), 1000, 1_000_000), 0, 1_000_000)
    fleet.take(live_update("old", "vesc", live, 1000, 1_000_000), 0, 1_000_000)
    states = [
        [car.state(1_000_000 + round(after_s * 1e6)) for car in fleet.cars()]
        for after_s in (STALE_S + 0.1, 10 + STALE_S - 0.1, 10 + STALE_S + 0.1, 10 + GONE_S + 0.1)
    ]
    assert states == [["online", "stale"], ["online", "gone"], ["stale", "gone"], ["gone", "gone"]]
