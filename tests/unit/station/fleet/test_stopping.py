"""The emergency stop of one robot and of a fleet: asked for at once, and told as the robots confirm it."""

from __future__ import annotations

import io
import json
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from types import SimpleNamespace
from typing import Any

import pytest
from botocore.exceptions import ClientError
from typer.testing import CliRunner

from iort_agent.control.shadow import _merged
from iort_contract.messages.commands import NO_MOTION, DriveLimits, encode_limits
from iort_contract.messages.shadow import Pressed, encode_stop
from iort_contract.messages.video import VideoTerms, encode_terms
from iort_station.cli.verbs import control as verb
from iort_station.cli.verbs.robots import commands as robots
from iort_station.errors import StationError, UsageError
from iort_station.fleet.seat import driver_of
from iort_station.operations.alarms import user
from iort_station.page import answers, motion
from testkit.agent import ManualClock
from testkit.waiting import GUARD_S

# A page that shows every stop.
NOW = {"seen_ms": str(10**15)}
LIMITS = DriveLimits("drive", "drive.speed", "drive.steering_angle", 2.0, 0.4, 500)


class Shadows:
    """A cloud with the rows of two robots, and their shadows. ``broken`` is a robot whose shadow cannot be
    changed."""

    class exceptions:
        class ResourceNotFoundException(Exception):
            """There is no shadow."""

    def __init__(self) -> None:
        self.rows: dict[str, dict[str, Any]] = {
            name: {"robot": {"S": name}, "online": {"BOOL": True}, "connected_ms": {"N": "1"}}
            for name in ("car7", "car8")
        }
        # The registry answers once it is set.
        self.registry = threading.Event()
        self.registry.set()
        self.changed: list[str] = []
        self.states: dict[str, Any] = {"car7": {"reported": {"drive": encode_limits(LIMITS)}}}
        self.broken = ""
        self.version = 1
        # Called when a shadow has been read.
        self.read = lambda: None

    def client(self, _service: str) -> Shadows:
        return self

    def urgent(self) -> Shadows:
        return self

    def output(self, _noun: str, name: str) -> str:
        return name

    def get_item(self, *, TableName: str, Key: Any, ConsistentRead: bool) -> dict[str, Any]:
        assert self.registry.wait(GUARD_S)
        row = self.rows.get(Key["robot"]["S"])
        return {"Item": row} if row else {}

    def get_paginator(self, _operation: str) -> Shadows:
        return self

    def paginate(self, *, TableName: str) -> list[dict[str, Any]]:
        assert self.registry.wait(GUARD_S)
        return [{"Items": list(self.rows.values())}]

    def delete_thing_shadow(self, *, thingName: str, shadowName: str) -> None:
        del self.states[thingName]

    def get_thing_shadow(self, *, thingName: str, shadowName: str) -> dict[str, Any]:
        if thingName not in self.states:
            raise self.exceptions.ResourceNotFoundException
        state = {"state": self.states[thingName], "version": self.version}
        self.read()
        return {"payload": io.BytesIO(json.dumps(state).encode())}

    def update_thing_shadow(self, *, thingName: str, shadowName: str, payload: str) -> None:
        if thingName == self.broken:
            raise ClientError({"Error": {"Code": "ThrottlingException"}}, "UpdateThingShadow")
        document = json.loads(payload)
        if document.get("version", self.version) != self.version:
            raise ClientError({"Error": {"Code": "ConflictException"}}, "UpdateThingShadow")
        self.states[thingName] = _merged(self.states.get(thingName, {}), document["state"])
        self.changed.append(thingName)
        self.answer(thingName)

    def answer(self, robot: str) -> None:
        """A robot hears of the change."""

    def confirm(self, robot: str, *, stopped: bool) -> None:
        self.states[robot].setdefault("reported", {})["motion"] = {"stopped": stopped}


@pytest.fixture
def cloud():
    return Shadows()


def test_a_stop_counts_once_the_robot_has_confirmed_it(cloud):
    told = motion.fleet(cloud).stop({"robot": "car7", "stopped": "true"})["robots"]
    assert (told["car7"]["asked"], told["car7"]["stopped"]) == (True, None)
    cloud.confirm("car7", stopped=True)
    told = motion.fleet(cloud).motion({"robot": "car7"})["robots"]["car7"]
    assert (told["asked"], told["stopped"]) == (True, True)
    assert told["drive"] == vars(LIMITS)
    assert told["video"] is None
    told = motion.fleet(cloud).stop({"robot": "car7", "stopped": "false", **NOW})["robots"]["car7"]
    assert (told["asked"], told["stopped"]) == (False, True)


def test_a_robot_with_a_camera_tells_how_old_a_picture_may_be_and_is_driven_from_a_terminal_blind(cloud):
    terms = VideoTerms(640, 480, 15.0, 300)
    cloud.states["car7"]["reported"]["video"] = encode_terms(terms)
    assert motion.fleet(cloud).motion({"robot": "car7"})["robots"]["car7"]["video"] == vars(terms)
    with pytest.raises(UsageError, match=r"takes no motion without its picture.*\(--blind\)"):
        driver_of(cloud, "car7", by="ada", top_mps=1.0, blind=False)
    assert cloud.changed == []
    driver = driver_of(cloud, "car7", by="ada", top_mps=9.0, blind=True)
    assert (driver.by, driver.top_mps, driver.unsighted) == ("ada", 2.0, True)


def test_a_robot_without_a_camera_is_driven_as_ever(cloud):
    for blind in (False, True):
        assert not driver_of(cloud, "car7", by="ada", top_mps=1.0, blind=blind).unsighted
    cloud.states["car7"]["desired"] = {"motion": {"stopped": True}}
    with pytest.raises(StationError, match="iort stop car7 --release"):
        driver_of(cloud, "car7", by="ada", top_mps=1.0, blind=False)
    with pytest.raises(StationError, match=r"no downlink\.drive"):
        driver_of(cloud, "car8", by="ada", top_mps=1.0, blind=True)


def test_a_stop_of_the_fleet_is_seen_at_once(cloud):
    ask, act = motion.fleet(cloud).motion, motion.fleet(cloud).stop
    assert not ask({})["robots"]["car8"]["asked"]
    act({"stopped": "true"})
    assert ask({})["robots"]["car8"]["asked"]


def test_a_stop_waits_for_no_reading_of_the_fleet(cloud):
    ask, act = motion.fleet(cloud).motion, motion.fleet(cloud).stop
    reading, go = threading.Event(), threading.Event()

    def held() -> None:
        cloud.read = lambda: None
        reading.set()
        assert go.wait(GUARD_S)

    cloud.read = held
    with ThreadPoolExecutor(2) as pool:
        try:
            slow = pool.submit(ask, {})
            assert reading.wait(GUARD_S)
            assert pool.submit(act, {"stopped": "true"}).result(GUARD_S)["robots"]["car7"]["asked"]
        finally:
            go.set()
        slow.result(GUARD_S)


def test_a_robot_with_impossible_limits_keeps_no_other_from_its_stop(cloud):
    cloud.states["car7"]["reported"]["drive"]["max_speed_mps"] = 10**400
    told = motion.fleet(cloud).stop({"stopped": "true"})["robots"]
    assert told["car8"]["asked"]
    assert told["car7"]["drive"] is None


def rejects(cloud: Shadows, robot: str) -> None:
    """A robot without a motion command answers a stop."""
    rejection = {"value": True, "reason": NO_MOTION}
    said = {"moves": False, "motion": {"stopped": False}, "rejected": {"motion.stopped": rejection}}
    cloud.states[robot] = _merged(cloud.states.get(robot, {}), {"reported": said})


def test_a_robot_that_cannot_be_stopped_says_so_before_and_after_a_stop(cloud):
    cloud.states = {"car7": {"reported": {"moves": True}}, "car8": {"reported": {"moves": False}}}
    ask, act = motion.fleet(cloud).motion, motion.fleet(cloud).stop
    before = ask({})["robots"]
    assert {robot: one["stoppable"] for robot, one in before.items()} == {"car7": True, "car8": False}
    assert NO_MOTION in before["car8"]["why_not"]
    act({"stopped": "true"})
    cloud.confirm("car7", stopped=True)
    rejects(cloud, "car8")
    after = {robot: ask({"robot": robot})["robots"][robot] for robot in ("car7", "car8")}
    assert {robot: (one["stands"], one["asked"]) for robot, one in after.items()} == {
        "car7": (True, True),
        "car8": (False, False),
    }
    assert after["car8"]["reason"] == NO_MOTION


def test_a_robot_that_has_not_said_whether_it_can_be_stopped_is_no_stopped_one(cloud):
    told = motion.fleet(cloud).motion({"robot": "car8"})["robots"]["car8"]
    assert (told["stoppable"], told["stands"]) == (None, False)
    assert "has not said" in told["why_not"]


def test_a_rejected_stop_is_over_with_the_release_of_the_fleet(cloud):
    act = motion.fleet(cloud).stop
    act({"robot": "car8", "stopped": "true"})
    rejects(cloud, "car8")
    act({"stopped": "true"})
    told = act({"stopped": "false", **NOW})["robots"]["car8"]
    assert (told["asked"], told["alone"]) == (False, False)
    assert cloud.states["car8"]["desired"]["motion"]["stopped"] is False


def test_a_robot_that_stands_without_having_been_asked_is_no_unconfirmed_release(cloud):
    cloud.confirm("car7", stopped=True)
    told = motion.fleet(cloud).motion({"robot": "car7"})["robots"]["car7"]
    assert (told["asked"], told["stopped"]) == (True, True)


def test_the_release_of_the_fleet_leaves_a_robot_that_was_stopped_alone(cloud):
    act = motion.fleet(cloud).stop
    act({"robot": "car7", "stopped": "true"})
    told = act({"stopped": "true"})["robots"]
    assert {robot: one["alone"] for robot, one in told.items()} == {"car7": True, "car8": False}
    assert told["car8"]["by"] == user()
    assert abs(told["car8"]["at_ms"] / 1000 - time.time()) < 60
    told = act({"stopped": "false", **NOW})["robots"]
    assert {robot: one["asked"] for robot, one in told.items()} == {"car7": True, "car8": False}
    assert told["car8"]["by"] == user(), "who released it"
    assert not act({"robot": "car7", "stopped": "false", **NOW})["robots"]["car7"]["asked"]
    # Stopped by an older station, or by `iort config`: nobody knows with what.
    cloud.states["car8"] = {"desired": {"motion": {"stopped": True}}}
    assert act({"stopped": "false", **NOW})["robots"]["car8"]["asked"]


def test_a_stop_at_the_moment_of_a_fleets_release_is_not_lost(cloud):
    act = motion.fleet(cloud).stop
    act({"stopped": "true"})

    def somebody_stops() -> None:
        cloud.version += 1

    cloud.read = somebody_stops
    assert set(act({"stopped": "false", **NOW})["failed"]) >= {"car7"}
    assert cloud.states["car7"]["desired"]["motion"]["stopped"]


@pytest.mark.parametrize("whom", [{}, {"robot": "car7"}])
def test_a_release_ends_no_stop_that_the_page_does_not_show(cloud, whom):
    act = motion.fleet(cloud).stop
    seen = act({"stopped": "true", **whom})["robots"]["car7"]["at_ms"]
    newer = encode_stop(Pressed("anna", seen + 1), fleet=not whom)
    cloud.states["car7"] = _merged(cloud.states["car7"], {"desired": newer})
    told = act({"stopped": "false", "seen_ms": str(seen), **whom})
    assert told["failed"] == {"car7": "anna has stopped it again since"}
    assert cloud.states["car7"]["desired"]["motion"]["stopped"]
    told = act({"stopped": "false", "seen_ms": str(seen + 1), **whom})
    assert not told["robots"]["car7"]["asked"]


def test_every_robot_of_a_fleet_is_tried_also_after_one_that_fails(cloud):
    cloud.broken = "car7"
    told = motion.fleet(cloud).stop({"stopped": "true"})
    assert "Throttling" in told["failed"]["car7"]
    assert told["robots"]["car8"]["asked"]


def test_the_pages_settings_release_nothing(cloud):
    with pytest.raises(StationError, match="a button of its own"):
        answers.change(cloud, {"robot": "car7", "name": "motion.stopped", "value": "false"})
    assert "desired" not in cloud.states["car7"]


def test_a_stranger_or_an_unclear_wish_changes_nothing(cloud):
    told = motion.fleet(cloud).stop({"robot": "car9", "stopped": "true"})
    assert "robot car9 is not registered; the nearest: car" in told["failed"]["car9"]
    assert "car9" not in cloud.states
    with pytest.raises(StationError, match="not registered: car9; nothing is changed"):
        motion.fleet(cloud).stop({"robot": "car9", "stopped": "false", **NOW})
    with pytest.raises(StationError, match="stopped must be true or false"):
        motion.fleet(cloud).stop({"robot": "car7", "stopped": "yes"})
    assert "desired" not in cloud.states["car7"]


def iort_stop(cloud: Shadows, *arguments: str) -> Any:
    def found() -> Any:
        if cloud.broken == "everything":
            raise StationError("the embedded cloud does not answer")
        return cloud

    return CliRunner().invoke(verb.commands, ["stop", *arguments], obj=SimpleNamespace(cloud=found))


class Robots(Shadows):
    """Robots that answer at once: car7 stops, and car8 has no motion command."""

    def answer(self, robot: str) -> None:
        if robot == "car7":
            self.confirm(robot, stopped=self.states[robot]["desired"]["motion"]["stopped"])
            self.states[robot]["reported"]["moves"] = True
        elif self.states[robot]["desired"]["motion"]["stopped"]:
            rejects(self, robot)
        else:
            self.states[robot]["reported"]["rejected"] = {}


def test_the_command_names_first_and_in_plain_words_who_does_not_stand():
    cloud = Robots()
    done = iort_stop(cloud, "--all")
    assert done.stdout.splitlines() == [
        f"car8: NOT STOPPED: a stop does nothing there: {NO_MOTION}",
        "car7: stopped",
    ]
    assert "NOT known to stand: car8." in done.stderr
    assert done.exit_code == 1
    released = iort_stop(cloud, "--all", "--release")
    assert "car7: released" in released.stdout
    assert "car8: was not stopped" in released.stdout
    assert "stays stopped" not in released.output
    assert released.exit_code == 0


def test_a_named_robot_is_stopped_and_its_answer_told_while_the_registry_is_silent():
    cloud = Robots()
    cloud.registry.clear()
    try:
        done = iort_stop(cloud, "car7")
        assert done.stdout == "car7: stopped\n"
        assert "stop sent to car7" in done.stderr
    finally:
        cloud.registry.set()


def test_a_robot_that_does_not_answer_is_told_after_a_second_with_what_else_stops_it(cloud, monkeypatch):
    clock = ManualClock()
    monkeypatch.setattr(verb, "time", SimpleNamespace(monotonic=clock.monotonic, sleep=clock.advance))
    done = iort_stop(cloud, "car7", "--seconds", "1.2")
    assert "no answer after 1 s from car7" in done.stderr
    assert "use the switch at the car" in done.stderr
    assert "car7: NOT CONFIRMED: it has not answered" in done.stdout
    assert done.exit_code == 1


def test_a_robot_that_is_away_is_not_waited_for_nor_said_to_stand(cloud):
    cloud.rows["car7"]["online"] = {"BOOL": False}
    done = iort_stop(cloud, "car7", "--seconds", str(GUARD_S))
    assert "car7: NOT CONFIRMED: it is not connected" in done.stdout
    assert "NOT known to stand: car7" in done.stderr
    assert done.exit_code == 0


def test_a_stranger_is_no_stopped_robot_and_said_before_anything_else(cloud, monkeypatch):
    monkeypatch.setattr(verb, "_LOOK_S", GUARD_S)
    done = iort_stop(cloud, "car9", "--seconds", str(GUARD_S))
    assert done.stderr.startswith("iort: robot car9 is not registered; the nearest: car")
    assert "sent to" not in done.stderr
    assert "car9: NOT STOPPED: robot car9 is not registered" in done.stdout
    assert done.exit_code == 1
    assert "car9" not in cloud.states


@pytest.mark.parametrize("broken", ["everything", "car7"])
def test_a_stop_that_reaches_no_cloud_says_first_that_nothing_was_stopped(cloud, broken):
    cloud.broken = broken
    done = iort_stop(cloud, "car7")
    first, ends, *rest = str(done.exception).splitlines()
    assert first == "NOTHING WAS STOPPED."
    assert "0.5 s after the last command" in ends
    assert "10 s at most" in ends
    assert "use the switch at the car" in ends
    assert rest[-1].startswith("The cloud: ")
    assert done.exit_code == 1


def test_the_list_of_robots_says_before_it_is_needed_whom_a_stop_does_not_stop(cloud):
    cloud.states = {"car7": {"reported": {"moves": True}}, "car8": {"reported": {"moves": False}}}
    cloud.rows["car9"] = {"robot": {"S": "car9"}}
    asked = SimpleNamespace(cloud=lambda: cloud)
    listed = CliRunner().invoke(robots, ["list", "--json"], obj=asked)
    assert [(one["robot"], one["stoppable"]) for one in json.loads(listed.stdout)] == [
        ("car7", True),
        ("car8", False),
        ("car9", None),
    ]
    shown = CliRunner().invoke(robots, ["list"], obj=asked)
    assert f"an emergency stop does NOT stop car8: {NO_MOTION}" in shown.stderr
