"""A recording is uploaded through the cloud and exported again."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
from mcap.reader import make_reader
from rosbags.highlevel import AnyReader
from rosbags.rosbag1 import Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from iort_contract.ros.decode import HEADER
from iort_station import data
from iort_station.cloud import Cloud
from iort_station.times import iso
from tests.foxglove import flat, opened
from tests.local.conftest import run_agent
from tests.recordings import recording

VESC, SERVO = "/sensors/core", "/sensors/servo_position_command"


def messages(path: Path, topic: str) -> tuple[Any, list[tuple[int, bytes]]]:
    """Return a topic's type, checksum and definition, and its messages with their recording times."""
    with AnyReader([path]) as reader:
        (connection,) = (c for c in reader.connections if c.topic == topic)
        found = [(t_ns, bytes(raw)) for _, t_ns, raw in reader.messages(connections=[connection])]
    return (connection.msgtype, connection.digest, connection.msgdef.data), found


def stamp_ns(raw: bytes) -> int:
    """Return the stamp of a message that begins with a header."""
    _, sec, nanosec, _ = HEADER.unpack_from(raw)
    return int(sec) * 10**9 + int(nanosec)


def data_of(cloud: Cloud, robot: str, stream: str) -> list[tuple[int, dict[str, Any]]]:
    """Convert a queried message to the form of Foxglove's libraries. VescStateStamped has its fields in
    ``state``, and a 64-bit integer is a text.
    """
    found = data.query(cloud, robot, stream)
    within = "state." if stream == "vesc" else ""
    columns = {f"{within}{name}": column.tolist() for name, column in found.columns.items()}
    if "ticks" in columns:
        columns["ticks"] = [str(ticks) for ticks in columns["ticks"]]
    return [
        (t_us * 1000, {name: column[i] for name, column in columns.items()})
        for i, t_us in enumerate(found.times_us.tolist())
    ]


LAB = "/lab/wheels"
LAB_TYPE = "lab_msgs/msg/Wheels"
LAB_DEFINITION = (
    "std_msgs/Header header\nstring surface\ntime at\nint64 ticks\nfloat32[4] slip\nWheel[2] driven\n"
    + "=" * 80
    + "\nMSG: lab_msgs/Wheel\nfloat64 rate\nbool locked\n"
)
LAB_COUNT = 200


def lab_bag(path: Path) -> Path:
    """Write a recording of a type that no library knows, and change its frame half-way."""
    store = get_typestore(Stores.ROS1_NOETIC)
    store.register(get_types_from_msg(LAB_DEFINITION, LAB_TYPE))
    made = store.types
    with Writer(path) as writer:
        connection = writer.add_connection(LAB, LAB_TYPE, typestore=store)
        for i in range(LAB_COUNT):
            t_ns = 1_600_000_000_000_000_000 + i * 20_000_000
            stamp = made["builtin_interfaces/msg/Time"](*divmod(t_ns, 10**9))
            frame = "base_link" if i < LAB_COUNT // 2 else "odom"
            message = made[LAB_TYPE](
                header=made["std_msgs/msg/Header"](seq=i, stamp=stamp, frame_id=frame),
                surface=f"gr\u00fcn {i % 3}",
                at=stamp,
                ticks=2**60 + i,
                slip=np.arange(4, dtype=np.float32) / (i + 1),
                driven=[made["lab_msgs/msg/Wheel"](rate=i / 7, locked=bool(i % 2)) for _ in range(2)],
            )
            writer.write(connection, t_ns, store.serialize_ros1(message, LAB_TYPE))
    return path


def _becomes_a_dataset(cloud, robot, iort, dataset):
    learning = ["export", robot, "--format", "lerobot", "--last", "all", "--out", str(dataset)]
    done = iort(*learning)
    assert "has no analysed drives in this range: run `iort analyse`" in str(done.exception)
    done = iort(*learning, "--episodes", "runs", "--fps", "50")
    assert done.exit_code == 0, done.output
    episodes = json.loads((dataset / "meta/iort.json").read_text())["episodes"]
    rows = pq.read_table(dataset / "data").num_rows
    assert done.stdout.strip().endswith(f": {len(episodes)} episodes of {rows:,} frames")
    longest = max(episodes, key=lambda one: one["to_us"] - one["from_us"])
    within = ["--from", iso(longest["from_us"]), "--to", iso(longest["to_us"])]
    alone = [*learning[:4], *within, "--out", f"{dataset}-of-one", "--episodes", "runs", "--fps", "50"]
    assert ": 1 episode of " in iort(*alone).stdout
    assert "action: servo.data" in done.stderr
    recorded = data.query(cloud, robot, "vesc", fields=["current_motor"]).columns["current_motor"]
    frames = pq.read_table(dataset / "data").to_pydict()
    currents = [row[1] for row in frames["observation.state"]]
    assert set(currents) <= set(recorded.astype(np.float32).tolist())
    assert len(set(currents)) > 300
    assert len(frames["action"]) == frames["index"][-1] + 1 > 1000


@pytest.mark.timeout(300)
def test_an_exported_bag_equals_the_recorded_bag(embedded, bundle, iort, tmp_path):
    original, lab = recording("f1tenth-motor-servo.bag"), lab_bag(tmp_path / "lab.bag")
    robot = bundle(
        sources=[
            {
                "type": "bag",
                "path": str(original),
                "topics": {VESC: "vesc", SERVO: "servo"},
                "speed": 0,
                "stamps": "original",
            },
            {
                "type": "bag",
                "path": str(lab),
                "topics": {LAB: "lab"},
                "speed": 0,
                "stamps": "original",
            },
        ],
        live={"enabled": False},
    )
    report = run_agent(robot)
    assert report["streams"]["types"]["samples"] == 3
    exported = tmp_path / "again.bag"
    asked = ["export", robot.robot, "vesc", "servo", "lab", "--last", "all", "--out"]
    done = iort(*asked, str(exported))
    assert done.exit_code == 0, done.output
    assert "2,244 messages of vesc_msgs/VescStateStamped on /sensors/core" in done.stderr

    # Messages are equal byte for byte, under the recorded definition, at the time of their stamps if they
    # have one.
    for source, topic, count in ((original, VESC, 2244), (original, SERVO, 879), (lab, LAB, LAB_COUNT)):
        (kind, went), (again, came) = messages(source, topic), messages(exported, topic)
        assert kind == again
        assert [raw for _, raw in came] == [raw for _, raw in went]
        assert len(came) == count
        stamps = [recorded_ns if topic == SERVO else stamp_ns(raw) for recorded_ns, raw in went]
        assert [t_ns for t_ns, _ in came] == [stamp // 1000 * 1000 for stamp in stamps]

    _becomes_a_dataset(embedded.cloud, robot.robot, iort, tmp_path / "dataset")

    mcap = tmp_path / "again.mcap"
    done = iort(*asked, str(mcap))
    assert done.exit_code == 0, done.output
    with mcap.open("rb") as file:
        reader = make_reader(file)
        summary = reader.get_summary()
        assert summary is not None
        assert {(s.name, s.encoding) for s in summary.schemas.values()} == {
            ("vesc_msgs/VescStateStamped", "ros1msg"),
            ("std_msgs/Float64", "ros1msg"),
            ("lab_msgs/Wheels", "ros1msg"),
        }
        written = [message.data for _, _, message in reader.iter_messages(topics=[VESC])]
    with AnyReader([exported]) as bag:
        raw = [raw for c, _, raw in bag.messages() if c.topic == VESC]
    assert written == raw

    for path in (mcap, exported):
        foxglove = opened(path)
        for topic, stream in ((VESC, "vesc"), (SERVO, "servo"), (LAB, "lab")):
            asked_for = data_of(embedded.cloud, robot.robot, stream)
            shown = [(t_ns, flat(message)) for t_ns, message in foxglove.messages[topic]]
            assert shown == asked_for, (path, topic)

    folder = tmp_path / "again"
    done = iort(*asked, str(folder))
    assert done.exit_code == 0, done.output
    assert "on /sensors/core, of ROS 1, converted to ROS 2, without the seq of headers" in done.stderr
    with AnyReader([folder]) as ros2, AnyReader([exported]) as ros1:
        pairs = zip(ros2.messages(), ros1.messages(), strict=True)
        for (one, one_ns, data), (other, other_ns, raw) in pairs:
            assert (one.topic, one.msgtype, one_ns) == (other.topic, other.msgtype, other_ns)
            message, published = ros2.deserialize(data, one.msgtype), ros1.deserialize(raw, other.msgtype)
            if one.topic == VESC:
                # Each reader has classes of its own.
                assert repr(message.header.stamp) == repr(published.header.stamp)
                assert repr(message.state) == repr(published.state)

    done = iort(*asked, str(exported))
    assert "exists" in str(done.exception)
