"""Who drives, how far, and the emergency stop, with fakes for ROS and the network."""

from __future__ import annotations

import errno
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest

from iort_agent.control.guard import StopFile
from iort_agent.errors import ConfigError
from testkit.agent import ManualClock
from tests.unit.agent.control.downlink_rig import T0, FakeGuard, Rig, doubles

POSE: dict[str, Any] = {
    "cmd": {
        "pose": {
            "topic": "/pose",
            "type": "geometry_msgs/PoseStamped",
            "partial": True,
            "motion": {"stop": {}},
        }
    },
    "drive": {
        "command": "pose",
        "speed": "pose.position.x",
        "steering": "pose.position.y",
        "max_speed_mps": 1.0,
        "max_steering_rad": 0.5,
    },
}
A, B = "aaaaaaaa", "bbbbbbbb"


def driven(rig: Rig) -> list[tuple[Any, ...]]:
    keys = ("by", "outcome", "driver_by", "lease_left_ms", "speed", "steering")
    return [tuple(sample[key] for key in keys) for sample in rig.drove]


def drive(rig: Rig, session: str, x: float, y: float = 0.0, **changes: Any) -> None:
    by = {A: "anna", B: "bert"}.get(session, "cora")
    position = {"position": {"x": x, "y": y, "z": 7.0}}
    rig.send({"pose": position}, name="pose", session=session, started_us=T0 - 10, by=by, **changes)


def test_every_command_is_limited_and_told_as_the_robot_got_it() -> None:
    rig = Rig(**POSE)
    drive(rig, A, 9.0, -9.0)
    drive(rig, A, 0.5, 0.25)
    assert [data[-56:-32] for _, data in rig.graph.published] == [
        doubles(1.0, -0.5, 7.0),
        doubles(0.5, 0.25, 7.0),
    ]
    assert driven(rig) == [
        ("anna", "accepted", "anna", 300, 1.0, -0.5),
        ("anna", "accepted", "anna", 300, 0.5, 0.25),
    ]
    assert rig.downlink.report()["commands"]["pose"] == {"passed": 2, "stops": 0, "limited": 1}


@pytest.mark.parametrize("x", [True, "9", None, float("inf"), [9.0]])
def test_what_is_no_number_is_not_limited_but_refused(x: Any) -> None:
    rig = Rig(**POSE)
    payload = (
        f'{{"v":1,"session":"{A}","started_us":{T0},"seq":0,"sent_us":{T0},"valid_ms":500,"lease_ms":300,'
    )
    text = (
        "1e999"
        if x == float("inf")
        else {True: "true", None: "null"}.get(x)
        if not isinstance(x, (str, list))
        else f'"{x}"'
    )
    rig.send(
        {}, name="pose", raw=(payload + f'"message":{{"pose":{{"position":{{"x":{text}}}}}}}}}').encode()
    )
    assert rig.graph.published == []
    assert rig.refused() == {"cmd/iort/car1/pose malformed": 1}


def test_the_samples_tell_who_drives_who_was_refused_and_when_the_robot_stopped() -> None:
    rig = Rig(**POSE)
    drive(rig, A, 0.5)
    drive(rig, B, -0.5)
    drive(rig, B, -0.5)
    rig.clock.advance(0.3)
    rig.downlink.tick()
    assert driven(rig) == [
        ("anna", "accepted", "anna", 300, 0.5, 0.0),
        ("bert", "driven_by_another", "anna", 300, None, None),
        ("anna", "stopped", None, 0, 0.0, 0.0),
    ]


def test_the_emergency_stop_stops_at_once_and_refuses_until_it_is_released() -> None:
    rig = Rig()
    rig.send({"data": 2.5}, session=A)
    rig.downlink.set_stopped(True)
    assert rig.graph.published[1:] == [("/commands/motor/speed", doubles(0.0))]
    for _ in range(50):
        rig.clock.advance(0.1)
        rig.downlink.tick()
    assert len(rig.graph.published) == pytest.approx(52, abs=2), "it holds its place on the topic"
    assert rig.downlink.alarms() == ["emergency stop: no motion until an operator releases it"]
    rig.send({"data": 2.5}, session=B, takeover=True)
    rig.send({"data": "hello"}, name="say", lease_ms=None)
    rig.clock.advance(0.1)
    rig.downlink.set_stopped(False)
    rig.send({"data": 2.5}, session=B, takeover=True)
    assert rig.refused() == {
        "cmd/iort/car1/speed emergency_stop": 1,
        "cmd/iort/car1/speed begin_again": 1,
    }
    assert [sample["outcome"] for sample in rig.drove] == [
        "accepted",
        "stopped",
        "emergency_stop",
        "begin_again",
    ]
    rig.send({"data": 1.5}, session="cccccccc")
    assert rig.graph.published[-1] == ("/commands/motor/speed", doubles(1.5))
    assert rig.downlink.alarms() == []


def test_an_agent_that_ends_by_itself_leaves_an_emergency_stop_to_the_guard() -> None:
    guard = FakeGuard(ManualClock(now_us=T0))
    rig = Rig(guard=guard)
    rig.downlink.set_stopped(True)
    rig.downlink.halt(keep_stop=True)
    rig.downlink.close(keep_stop=True)
    assert guard.left
    assert [held for _, _, held in guard.told] == [True]


def test_a_stopped_robot_ends_in_good_order() -> None:
    rig = Rig()
    rig.downlink.set_stopped(True)
    rig.downlink.close()
    assert rig.clock.monotonic() < 1002
    assert rig.graph.closed


def test_before_the_operators_settings_are_known_nothing_moves() -> None:
    rig = Rig()
    rig.settings_known = False
    rig.send({"data": 2.5})
    rig.send({"data": "hello"}, name="say", lease_ms=None)
    assert [topic for topic, _ in rig.graph.published] == ["/say"]
    assert rig.refused() == {"cmd/iort/car1/speed settings_unknown": 1}
    rig.settings_known = True
    rig.send({"data": 2.5})
    assert rig.graph.published[-1][1] == doubles(2.5)


@pytest.mark.parametrize(
    ("change", "error"),
    [
        (
            {"steering": "pose.position.w"},
            "downlink.drive: pose.position.w: geometry_msgs/Point has no such field",
        ),
        ({"max_speed_mps": 0}, "max_speed_mps: must be a number from 0.01"),
        ({"speed": "pose.0"}, "must not be an array"),
        ({"speed": "pose.__proto__.x"}, "nor begin with _"),
    ],
)
def test_a_wrong_configuration(change: Any, error: str) -> None:
    with pytest.raises(ConfigError, match=error):
        Rig(cmd=POSE["cmd"], drive={**POSE["drive"], **change})


def test_a_message_with_other_fields_needs_partial() -> None:
    pose = {**POSE["cmd"]["pose"], "partial": False}
    with pytest.raises(ConfigError, match=r"z: is missing; downlink\.cmd\.pose\.partial must be true"):
        Rig(cmd={"pose": pose}, drive=POSE["drive"])


def test_an_emergency_stop_is_kept_once_the_disk_works_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    queue = tmp_path / "queue.db"
    kept = StopFile(queue)
    with monkeypatch.context() as full:
        full.setattr(Path, "touch", Mock(side_effect=OSError(errno.ENOSPC, "No space left on device")))
        kept.write(stopped=True)
        kept.tick()
        assert "No space left" in (kept.alarm or "")
        assert not StopFile(queue).stopped
    kept.tick()
    assert kept.alarm is None
    assert StopFile(queue).stopped
    kept.write(stopped=False)
    assert not StopFile(queue).stopped
