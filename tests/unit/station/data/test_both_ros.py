"""A stream from ROS 1 and the same values from ROS 2 are the same samples to everything behind the robot."""

from __future__ import annotations

import io
import json
from typing import Any

import pytest

from iort_analysis.archive.reading import ArchiveFile
from iort_analysis.archive.reading import items as stored_again
from iort_analysis.archive.writing import write_hour
from iort_analysis.samples.batches import in_order
from iort_analysis.samples.blocks import join, values
from iort_contract.archive import hour_of
from iort_contract.catalog.streams import TYPES_STREAM
from iort_contract.codec import CODEC, ROS1_CODEC, ROS2_CODEC
from iort_contract.dynamodb import plain
from iort_contract.messages.batch import Batch, decode_batch, messages_of
from iort_contract.ros.definition import parse
from iort_contract.ros.message import Messages, MessageType
from iort_contract.topics import build_topic
from iort_station import data
from testkit.dynamodb import TELEMETRY, FakeDynamoDB, item_of
from tests.unit.contract.ros.ros_values import HEADER, ROS2_HEADER, RULE, by_rosbags
from tests.unit.functions.summarizing import Stream
from tests.unit.station.data.test_queries import cloud_of

# Some fields with units.
KNOWN = {"angular_velocity.x", "linear.x", "steering_angle"}
BOOT, START, STREAM = "0badcafe", 1_700_000_000_000_000, "it"
TOPIC = build_topic("dt", "car", STREAM)
LINE = f"{RULE}\n"
VECTOR = f"{LINE}MSG: geometry_msgs/Vector3\nfloat64 x\nfloat64 y\nfloat64 z\n"
TWIST = f"{LINE}MSG: geometry_msgs/Twist\ngeometry_msgs/Vector3 linear\ngeometry_msgs/Vector3 angular\n"
IMU = "uint8 status\ngeometry_msgs/Vector3 angular_velocity\ngeometry_msgs/Vector3 linear_acceleration\n"
# A type's name, its own definition, its nested types, and the codec of its batches if that is no ROS's own.
KINDS: dict[str, tuple[str, str, str]] = {
    "lab_msgs/Motion": (f"std_msgs/Header header\n{IMU}float64[9] covariance\n", VECTOR, CODEC),
    "geometry_msgs/TwistStamped": (
        "std_msgs/Header header\ngeometry_msgs/Twist twist\n",
        TWIST + VECTOR,
        CODEC,
    ),
    "lab_msgs/Joints": (
        "std_msgs/Header header\nstring[] name\nfloat64[] position\nbool on\nfloat32[2] pair\n",
        "",
        "",
    ),
    "ackermann_msgs/AckermannDrive": ("float32 steering_angle\nfloat32 speed\nuint8[] image\n", "", ""),
    "std_msgs/Empty": ("", "", ""),
}


def message_of(kind: str, i: int, *, ros2: bool) -> dict[str, Any]:
    """The i-th message's values."""
    vector = {"x": i / 4, "y": float(i), "z": -1.5}
    message = {
        "lab_msgs/Motion": {"status": i, "angular_velocity": vector, "linear_acceleration": vector,
                            "covariance": [i / 8] * 9},
        "geometry_msgs/TwistStamped": {"twist": {"linear": vector, "angular": vector}},
        "lab_msgs/Joints": {"name": ["left", "rücken"][: i % 3], "position": [i / 2] * (i % 3),
                                   "on": i % 2 == 0, "pair": [float("nan"), 2.5]},
        "ackermann_msgs/AckermannDrive": {"steering_angle": i / 2, "speed": 1.25, "image": [1] * i},
        "std_msgs/Empty": {},
    }[kind]  # fmt: skip
    sec, microseconds = divmod(START + i * 10_000, 1_000_000)
    seq = {} if ros2 else {"seq": i}
    stamp = {"sec": sec, "nanosec": microseconds * 1000 + 123}
    header = {**seq, "stamp": stamp, "frame_id": "base_link"}
    return {"header": header, **message} if "header" in KINDS[kind][0] else message


def recorded(kind: str, *, ros2: bool) -> tuple[Batch, MessageType]:
    own, nested, _ = KINDS[kind]
    definition = own + (ROS2_HEADER if ros2 else HEADER) + nested
    name = kind.replace("/", "/msg/") if ros2 else kind
    declared = MessageType(STREAM, "/it", name, "RIHS01_" if ros2 else "1" * 32, definition)
    parsed = parse(name, definition)
    raws = [by_rosbags(parsed, message_of(kind, i, ros2=ros2)) for i in range(30)]
    times = [START + i * 10_000 for i in range(30)]
    return Batch(BOOT, 0, times, {}, 0, Messages(declared.id, declared.layout, raws)), declared


@pytest.mark.parametrize("kind", KINDS)
def test_both_are_the_same_samples(kind: str) -> None:
    seen = []
    for ros2, codec in ((False, ROS1_CODEC), (True, ROS2_CODEC)):
        batch, declared = recorded(kind, ros2=ros2)
        item = item_of(batch, TOPIC)
        assert plain(item)["codec"] == (KINDS[kind][2] or codec)
        layouts = {declared.id: declared.layout}
        assert batch.messages is not None
        assert messages_of(plain(item), layouts)[1] == batch.messages
        decoded = decode_batch(plain(item))
        seen.append(
            {
                "samples": (decoded.times_us, decoded.columns, decoded.nonfinite),
                "summary": summary(item),
                "archive": archived(item, batch, layouts),
                "query": queried(batch, declared),
            }
        )
    ros1, ros2 = seen
    assert ros1 == ros2
    assert ros1["summary"]
    assert bool(ros1["samples"][1]) == (kind != "std_msgs/Empty")


def summary(item: dict[str, Any]) -> Any:
    stream = Stream()
    stream.summarize([stream.store_item(item)])
    assert not stream.refused
    return stream.summary(TOPIC)


def archived(item: dict[str, Any], batch: Batch, layouts: dict[str, str]) -> Any:
    """The rows of the archive's file, which gives the same messages again."""
    into = io.BytesIO()
    write_hour([item], into, hour=hour_of(batch.t_us), refused=io.BytesIO(), scratch=io.BytesIO())
    file = ArchiveFile(into.getvalue())
    (again,) = stored_again(file, TOPIC)
    assert messages_of(plain(again), layouts)[1] == batch.messages
    assert plain(again)["codec"] == plain(item)["codec"]
    block = join(list(in_order(file.pages())))
    return block.times_us.tolist(), lists(block.columns)


def queried(batch: Batch, declared: MessageType) -> Any:
    """The result of a query, with its units."""
    cloud = cloud_of()
    sample = {name: [value] for name, value in declared.sample().items()}
    for stream, stored in ((STREAM, batch), (TYPES_STREAM, Batch(BOOT, 0, [START], sample))):
        client: FakeDynamoDB = cloud.table
        client.put(TELEMETRY, item_of(stored, build_topic("dt", "car", stream)))
    result = data.query(cloud, "car", STREAM)
    assert not result.refused
    units = {name: result.unit(name) for name in result.columns}
    assert any(units.values()) == bool(KNOWN.intersection(units))
    return result.times_us.tolist(), lists(result.columns), units


def lists(columns: Any) -> str:
    """The columns' values; as text NaN equals itself."""
    return json.dumps({name: values(column) for name, column in columns.items()})
