"""A recording in, through the cloud, a recording out."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import pytest
from mcap.reader import make_reader
from rosbags.highlevel import AnyReader

from tests.local.conftest import run_agent
from tests.local.test_query import iort
from tests.recordings import recording

VESC, SERVO = "/sensors/core", "/sensors/servo_position_command"


def messages(path: Path, topic: str) -> tuple[Any, list[Any]]:
    """Type and checksum of a topic, and its messages with the time at which each was recorded."""
    with AnyReader([path]) as reader:
        (connection,) = (c for c in reader.connections if c.topic == topic)
        found = [
            (t_ns, reader.deserialize(raw, connection.msgtype))
            for _, t_ns, raw in reader.messages(connections=[connection])
        ]
    return (connection.msgtype, connection.digest), found


@pytest.mark.timeout(300)
def test_a_bag_comes_back_as_it_went_in(embedded, bundle, tmp_path):
    original = recording("f1tenth-motor-servo.bag")
    robot = bundle(
        sources=[
            {
                "type": "bag",
                "path": str(original),
                "topics": {VESC: "vesc", SERVO: "servo"},
                "speed": 0,
                "stamps": "original",
            }
        ],
        live={"enabled": False},
    )
    report = run_agent(robot)
    assert report["streams"]["types"]["samples"] == 2
    exported = tmp_path / "again.bag"
    asked = ["export", robot.robot, "vesc", "servo", "--last", "all", "--output"]
    done = iort(*asked, str(exported), embedded=embedded)
    assert done.returncode == 0, done.stderr
    assert "2,244 messages of vesc_msgs/VescStateStamped on /sensors/core" in done.stderr

    kind, went = messages(original, VESC)
    assert kind == messages(exported, VESC)[0]
    came = messages(exported, VESC)[1]
    assert len(came) == len(went) == 2244
    fields = [f.name for f in dataclasses.fields(went[0][1].state) if f.name.islower() and f.name[0] != "_"]
    assert len(fields) == 13
    for (_, before), (t_ns, after) in zip(went, came, strict=True):
        assert [getattr(after.state, name) for name in fields] == [
            getattr(before.state, name) for name in fields
        ]
        # To the microsecond, and what has one time is not made another's.
        stamps = [m.header.stamp.sec * 10**9 + m.header.stamp.nanosec for m in (before, after)]
        assert stamps[0] // 1000 * 1000 == stamps[1] == t_ns

    kind, went = messages(original, SERVO)
    assert kind == messages(exported, SERVO)[0]
    came = messages(exported, SERVO)[1]
    assert [m.data for _, m in came] == [m.data for _, m in went]

    mcap = tmp_path / "again.mcap"
    done = iort(*asked, str(mcap), embedded=embedded)
    assert done.returncode == 0, done.stderr
    with mcap.open("rb") as file:
        reader = make_reader(file)
        summary = reader.get_summary()
        assert summary is not None
        assert {(s.name, s.encoding) for s in summary.schemas.values()} == {
            ("vesc_msgs/VescStateStamped", "ros1msg"),
            ("std_msgs/Float64", "ros1msg"),
        }
        data = [message.data for _, _, message in reader.iter_messages(topics=[VESC])]
    with AnyReader([exported]) as bag:
        raw = [raw for c, _, raw in bag.messages() if c.topic == VESC]
    assert data == raw

    done = iort(*asked, str(exported), embedded=embedded)
    assert done.returncode == 1
    assert "exists" in done.stderr
