"""The emergency stop of one robot and of a fleet: asked for at once, and told as the robots confirm it."""

from __future__ import annotations

import io
import json
import time
from typing import Any

import pytest
from botocore.exceptions import ClientError

from iort_agent.control.shadow import _merged
from iort_contract.messages.control.driving import NO_MOTION, DriveLimits, encode_limits
from iort_station.errors import StationError
from iort_station.fleet.control import stopping
from iort_station.operations.monitoring.alarms import user
from iort_station.page.answers import control, motion

# A page that shows every stop.
NOW = {"seen_ms": str(10**15)}
LIMITS = DriveLimits("drive", "drive.speed", "drive.steering_angle", 2.0, 0.4, 500)


class Shadows:
    """The shadows of two robots. ``broken`` is one whose shadow cannot be changed."""

    class exceptions:
        class ResourceNotFoundException(Exception):
            """There is no shadow."""

    def __init__(self) -> None:
        self.states: dict[str, Any] = {"car7": {"reported": {"drive": encode_limits(LIMITS)}}}
        self.broken = ""
        self.version = 1
        # Called when a shadow has been read.
        self.read = lambda: None

    def client(self, _service: str) -> Shadows:
        return self

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

    def confirm(self, robot: str, *, stopped: bool) -> None:
        self.states[robot].setdefault("reported", {})["motion"] = {"stopped": stopped}


@pytest.fixture
def cloud(monkeypatch):
    monkeypatch.setattr(stopping.registry, "listed", lambda _cloud: [{"robot": "car7"}, {"robot": "car8"}])
    monkeypatch.setattr(motion.registry, "presence", lambda _cloud: {"car7": {}, "car8": {}})
    return Shadows()


def test_a_stop_counts_once_the_robot_has_confirmed_it(cloud):
    told = motion.actions(cloud)["stop"]({"robot": "car7", "stopped": "true"})["robots"]
    assert (told["car7"]["asked"], told["car7"]["stopped"]) == (True, None)
    cloud.confirm("car7", stopped=True)
    told = motion.answers(cloud)["motion"]({"robot": "car7"})["robots"]["car7"]
    assert (told["asked"], told["stopped"]) == (True, True)
    assert told["drive"] == vars(LIMITS)
    told = motion.actions(cloud)["stop"]({"robot": "car7", "stopped": "false", **NOW})["robots"]["car7"]
    assert (told["asked"], told["stopped"]) == (False, True)


def test_a_stop_of_the_fleet_is_seen_at_once(cloud):
    ask, act = motion.answers(cloud)["motion"], motion.actions(cloud)["stop"]
    assert not ask({})["robots"]["car8"]["asked"]
    act({"stopped": "true"})
    assert ask({})["robots"]["car8"]["asked"]


def test_a_robot_with_impossible_limits_keeps_no_other_from_its_stop(cloud):
    cloud.states["car7"]["reported"]["drive"]["max_speed_mps"] = 10**400
    told = motion.actions(cloud)["stop"]({"stopped": "true"})["robots"]
    assert told["car8"]["asked"]
    assert told["car7"]["drive"] is None


def rejects(cloud: Shadows, robot: str) -> None:
    """A robot without a motion command answers a stop."""
    rejection = {"value": True, "reason": NO_MOTION}
    said = {"moves": False, "motion": {"stopped": False}, "rejected": {"motion.stopped": rejection}}
    cloud.states[robot] = _merged(cloud.states.get(robot, {}), {"reported": said})


def test_a_robot_that_cannot_be_stopped_says_so_before_and_after_a_stop(cloud):
    cloud.states = {"car7": {"reported": {"moves": True}}, "car8": {"reported": {"moves": False}}}
    ask, act = motion.answers(cloud)["motion"], motion.actions(cloud)["stop"]
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
    told = motion.answers(cloud)["motion"]({"robot": "car8"})["robots"]["car8"]
    assert (told["stoppable"], told["stands"]) == (None, False)
    assert "has not said" in told["why_not"]


def test_a_rejected_stop_is_over_with_the_release_of_the_fleet(cloud):
    act = motion.actions(cloud)["stop"]
    act({"robot": "car8", "stopped": "true"})
    rejects(cloud, "car8")
    act({"stopped": "true"})
    told = act({"stopped": "false", **NOW})["robots"]["car8"]
    assert (told["asked"], told["alone"]) == (False, False)
    assert cloud.states["car8"]["desired"]["motion"]["stopped"] is False


def test_a_robot_that_stands_without_having_been_asked_is_no_unconfirmed_release(cloud):
    cloud.confirm("car7", stopped=True)
    told = motion.answers(cloud)["motion"]({"robot": "car7"})["robots"]["car7"]
    assert (told["asked"], told["stopped"]) == (True, True)


def test_the_release_of_the_fleet_leaves_a_robot_that_was_stopped_alone(cloud):
    act = motion.actions(cloud)["stop"]
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
    act = motion.actions(cloud)["stop"]
    act({"stopped": "true"})

    def somebody_stops() -> None:
        cloud.version += 1

    cloud.read = somebody_stops
    assert set(act({"stopped": "false", **NOW})["failed"]) >= {"car7"}
    assert cloud.states["car7"]["desired"]["motion"]["stopped"]


@pytest.mark.parametrize("whom", [{}, {"robot": "car7"}])
def test_a_release_ends_no_stop_that_the_page_does_not_show(cloud, whom):
    act = motion.actions(cloud)["stop"]
    seen = act({"stopped": "true", **whom})["robots"]["car7"]["at_ms"]
    newer = stopping.encode_stop(stopping.Pressed("anna", seen + 1), fleet=not whom)
    cloud.states["car7"] = _merged(cloud.states["car7"], {"desired": newer})
    told = act({"stopped": "false", "seen_ms": str(seen), **whom})
    assert told["failed"] == {"car7": "anna has stopped it again since"}
    assert cloud.states["car7"]["desired"]["motion"]["stopped"]
    told = act({"stopped": "false", "seen_ms": str(seen + 1), **whom})
    assert not told["robots"]["car7"]["asked"]


def test_every_robot_of_a_fleet_is_tried_also_after_one_that_fails(cloud):
    cloud.broken = "car7"
    told = motion.actions(cloud)["stop"]({"stopped": "true"})
    assert "Throttling" in told["failed"]["car7"]
    assert told["robots"]["car8"]["asked"]


def test_the_pages_settings_release_nothing(cloud):
    with pytest.raises(StationError, match="a button of its own"):
        control.change(cloud, {"robot": "car7", "name": "motion.stopped", "value": "false"})
    assert "desired" not in cloud.states["car7"]


def test_a_stranger_or_an_unclear_wish_changes_nothing(cloud):
    with pytest.raises(StationError, match="not registered: car9; nothing is changed"):
        motion.actions(cloud)["stop"]({"robot": "car9", "stopped": "true"})
    with pytest.raises(StationError, match="stopped must be true or false"):
        motion.actions(cloud)["stop"]({"robot": "car7", "stopped": "yes"})
    assert "desired" not in cloud.states["car7"]
