"""The bridge on the embedded cloud: a car that is woken by a subscription, its past, and a panel that drives
it, by a client that is not ours."""

from __future__ import annotations

import json
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from iort_contract.messages.shadow import decode_reported
from iort_station import data
from iort_station.cloud import EMBEDDED
from iort_station.operations import audit
from local.demo import DOWNLINK
from testkit.waiting import until
from tests.bridge.judge import Judge, bridging
from tests.local.data.drives import Agent
from tests.local.robots.test_shadow import Shadow


@contextmanager
def bridge(folder: Path, *arguments: str) -> Iterator[dict[str, Any]]:
    """As `bridging`, for the cloud of a folder."""
    iort = [str(Path(sys.executable).parent / "iort"), "--local", "--embedded", str(folder / EMBEDDED.name)]
    with bridging([*iort, "bridge", *arguments, "--port", "0", "--json"]) as served:
        yield served


@pytest.fixture
def car(bundle: Any) -> Any:
    return bundle(sources=[{"type": "sim", "rate_hz": 50}], ping={"rate_hz": 5}, downlink=DOWNLINK)


def test_a_subscription_wakes_a_car_and_its_end_lets_it_sleep_and_the_past_is_what_was_seen(
    embedded: Any, car: Any
) -> None:
    cloud, robot = embedded.cloud, car.robot
    with Agent(car) as agent:
        until(agent.status)

        def viewers() -> int:
            return int(agent.told()["lanes"]["live"]["viewers"])

        until(lambda: list(audit.batches(cloud, robot, "vesc")))
        until(lambda: list(audit.batches(cloud, robot, "pose")))
        with bridge(embedded.folder, robot) as served, Judge(served["url"]) as judge:
            assert viewers() == 0
            assert "clientPublish" not in judge.of("server")[0]["info"]["capabilities"]
            schema = json.loads(judge.topics["/iort/vesc"]["schema"])
            assert schema["properties"]["voltage_input"]["description"].startswith("V: ")
            judge.do("subscribe", topic="/iort/vesc")
            until(lambda: viewers() == 1)
            seen = until(lambda: len(got := list(judge.got("/iort/vesc"))) >= 20 and got)
            judge.do("unsubscribe", topic="/iort/vesc")
            until(lambda: viewers() == 0)
        first_ns, last_ns = seen[0].t_ns, seen[-1].t_ns
    stored = data.query(cloud, robot, "vesc", first_ns // 1000, last_ns // 1000 + 1)
    columns = {name: data.values(column) for name, column in stored.columns.items()}
    recorded = {
        t_us * 1000: {name: column[i] for name, column in columns.items()}
        for i, t_us in enumerate(stored.times_us.tolist())
    }
    assert [one.fields for one in seen] == [recorded[one.t_ns] for one in seen]

    begin = f"{first_ns // 1000 / 1e6:.6f}"
    with bridge(embedded.folder, robot, "--last", "1h") as served, Judge(served["url"]) as judge:
        assert begin
        judge.do("subscribe", topic="/iort/vesc")
        began = judge.play("play", seek_ns=first_ns, speed=10.0)

        def played() -> dict[int, dict[str, Any]]:
            # What a paused panel was shown, of the begin of the hour, may come after the state of the seek.
            messages = judge.got("/iort/vesc", after=began)
            return {one.t_ns: one.fields for one in messages if first_ns <= one.t_ns <= last_ns}

        until(lambda: len(played()) >= len(recorded))
        assert played() == recorded


def test_a_panel_drives_the_car_and_the_car_stops_when_its_client_has_gone(embedded: Any, car: Any) -> None:
    cloud, robot, shadow = embedded.cloud, car.robot, Shadow(embedded, car.robot)
    pause, driven = threading.Event(), list[str]()
    with Agent(car):
        until(lambda: decode_reported(shadow.reported()).drive)
        with bridge(embedded.folder, robot, "--drive", "--max-speed", "1", "--by", "ada") as served:
            assert "?key=" in served["url"]
            with Judge(served["url"]) as judge:
                assert "clientPublish" in judge.of("server")[0]["info"]["capabilities"]
                judge.do("subscribe", topic="/iort/vesc")
                judge.do("advertise", topic="/odom", schema="nav_msgs/Odometry")
                until(lambda: any("only /cmd_vel" in one["text"] for one in judge.of("status")))
                judge.do("advertise", topic="/cmd_vel", schema="geometry_msgs/Twist")
                twist = {"linear": {"x": 0.5, "y": 0, "z": 0}, "angular": {"x": 0, "y": 0, "z": 0.1}}

                def said() -> str:
                    return str(judge.of("status")[-1]["text"])

                def held() -> bool:
                    """Hold the panel until the car is driven at its speed, and let go."""
                    while not any(
                        (one.fields.get("speed"), one.fields.get("driver_by")) == (0.5, "ada")
                        for one in judge.got("/iort/drive")
                    ) or not said().startswith("you drive"):
                        if said().startswith("let go"):
                            # On a slow machine it may have been refused.
                            until(lambda: not said().startswith("let go"))
                        judge.do("publish", topic="/cmd_vel", message=twist)
                        if "/iort/drive" in judge.topics and not driven:
                            # A stream that nobody had recorded before.
                            driven.append("/iort/drive")
                            judge.do("subscribe", topic="/iort/drive")
                        pause.wait(0.1)
                    # Silence is enough: the car stands, and waits.
                    until(lambda: not said().startswith("you drive"))
                    return said().startswith("the car stands")

                until(held)
        until(lambda: list(audit.batches(cloud, robot, "drive")))

        def ended() -> bool:
            told = data.query(cloud, robot, "drive", "-1h", "now")
            drivers = data.values(told.columns["driver"])
            return "accepted" in data.values(told.columns["outcome"]) and drivers[-1] is None

        until(ended)
    told = data.query(cloud, robot, "drive", "-1h", "now")
    assert max(speed for speed in data.values(told.columns["speed"]) if speed is not None) == 0.5
    assert "ada" in data.values(told.columns["by"])


def test_what_cannot_be_served_is_said_in_a_line(iort: Any, car: Any, tmp_path: Path) -> None:
    for arguments, words in (
        (["nobody"], "nobody"),
        ([car.robot, "--last", "1m"], "nothing is recorded in this range"),
        ([car.robot, "--last", "1m", "--drive"], "the past cannot be driven"),
        (["--drive"], "--drive needs the name of one robot"),
        ([str(tmp_path / "no.mcap")], "must be an MCAP file"),
        ([car.robot, "--incident", "0badcafe"], "give robots with a range"),
        (["--incident", "0badcafe"], "no incident 0badcafe"),
    ):
        done = iort("bridge", *arguments, "--port", "0")
        assert done.exit_code == 1, arguments
        assert words in str(done.exception), arguments
