"""Files of messages: each as it was published, or in the form of the other ROS. Read by rosbags and mcap."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import assume, given
from mcap.reader import make_reader
from rosbags import rosbag1, rosbag2
from rosbags.convert.converter import default_message
from rosbags.interfaces import QosDurability, QosReliability
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from iort_contract.ros.decode import Decoder
from iort_contract.ros.definition import parse
from iort_contract.ros.message import ROS2, MessageType
from iort_station.data import bags
from iort_station.data.ros_forms import ConversionError, form_of
from iort_station.errors import StationError
from testkit.ros1_types import Message
from tests.unit.contract.ros.ros1_messages import LINE
from tests.unit.station.data.test_export import of_some_definition

T_NS = 1_700_000_000_123_456_789
NOETIC, JAZZY = get_typestore(Stores.ROS1_NOETIC), get_typestore(Stores.ROS2_JAZZY)

WHEELS = MessageType(
    "wheels",
    "/wheels",
    "lab_msgs/msg/Wheels",
    "RIHS01_" + "5" * 64,
    '# As its author wrote it.\nuint8 LEFT=0\nstring<=20 name "none"\nfloat64[<=4] rates\nwstring label\n',
)
# Nobody here reads the bytes of this one: they are the file's whole task.
WHEELS_RAW = b"\0\1\0\0any bytes"


def declared(store: Any, name: str, topic: str) -> MessageType:
    """A type of a library's store as a robot declares it."""
    ros1 = store is NOETIC
    text, md5sum = store.generate_msgdef(name, ros_version=1 if ros1 else 2)
    kind = name.replace("/msg/", "/") if ros1 else name
    return MessageType(topic[1:], topic, kind, md5sum if ros1 else store.hash_rihs01(name), text)


def message(store: Any, name: str, **values: Any) -> Any:
    return store.types[name](**values)


def header(store: Any, **seq: int) -> Any:
    stamp = message(store, "builtin_interfaces/msg/Time", sec=1_700_000_000, nanosec=7)
    return message(store, "std_msgs/msg/Header", stamp=stamp, frame_id="map", **seq)


def point(store: Any, name: str = "Point") -> Any:
    return message(store, f"geometry_msgs/msg/{name}", x=1.5, y=-2.0, z=0.25)


POINT = "geometry_msgs/msg/PointStamped"
POINT_1 = NOETIC.serialize_ros1(
    message(NOETIC, POINT, header=header(NOETIC, seq=9), point=point(NOETIC)), POINT
)
POINT_2 = JAZZY.serialize_cdr(message(JAZZY, POINT, header=header(JAZZY), point=point(JAZZY)), POINT)


def of_mcap(path: Path) -> tuple[str, list[Any]]:
    """The profile, and each message with its schema and channel."""
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        return reader.get_header().profile, list(reader.iter_messages())


def of_folder(path: Path) -> Iterator[tuple[Any, int, bytes]]:
    with rosbag2.Reader(path) as reader:
        yield from reader.messages()


def test_an_mcap_has_messages_of_ros_2_byte_for_byte(tmp_path: Path) -> None:
    with bags.mcap(tmp_path / "a.mcap") as file:
        write, form = file.topic(WHEELS)
        write(T_NS, WHEELS_RAW)
    assert form.note == "as they were published"
    profile, [(schema, channel, one)] = of_mcap(tmp_path / "a.mcap")
    assert profile == "ros2"
    assert (schema.name, schema.encoding, schema.data.decode()) == (WHEELS.kind, "ros2msg", WHEELS.definition)
    assert (channel.topic, channel.message_encoding) == ("/wheels", "cdr")
    assert channel.metadata["topic_type_hash"] == WHEELS.md5sum
    assert (one.log_time, one.data) == (T_NS, WHEELS_RAW)


def test_a_folder_has_messages_of_ros_2_byte_for_byte(tmp_path: Path) -> None:
    latched = WHEELS._replace(topic="/car/tf_static")
    with bags.folder(tmp_path / "ride") as file:
        for i, kind in enumerate((WHEELS, latched, WHEELS)):
            file.topic(kind).write(T_NS + i, WHEELS_RAW)
    assert sorted(path.name for path in (tmp_path / "ride").iterdir()) == ["metadata.yaml", "ride.db3"]
    assert [path.name for path in tmp_path.iterdir()] == ["ride"]
    found = list(of_folder(tmp_path / "ride"))
    assert [(c.topic, t_ns - T_NS, raw) for c, t_ns, raw in found] == [
        ("/wheels", 0, WHEELS_RAW), ("/car/tf_static", 1, WHEELS_RAW), ("/wheels", 2, WHEELS_RAW),
    ]  # fmt: skip
    assert {(c.msgtype, c.digest, c.msgdef.data) for c, _, _ in found} == {
        (WHEELS.kind, WHEELS.md5sum, WHEELS.definition)
    }
    ((qos,), (qos_latched,)) = (c.ext.offered_qos_profiles for c, _, _ in found[:2])
    assert (qos.durability, qos_latched.durability) == (QosDurability.VOLATILE, QosDurability.TRANSIENT_LOCAL)
    assert {qos.reliability, qos_latched.reliability} == {QosReliability.RELIABLE}


# What rosidl of Jazzy says of std_msgs/msg/Char.
CHAR = "RIHS01_3ad2d04dd29ba19d04b16659afa3ccaedd691914b02a64e82e252f2fa6a586a9"


def test_a_hash_that_the_robot_did_not_have_is_made(tmp_path: Path) -> None:
    unknown = "sha256_" + "0" * 64
    point, char = declared(JAZZY, POINT, "/point"), declared(JAZZY, "std_msgs/msg/Char", "/char")
    with bags.folder(tmp_path / "ride") as file:
        for kind in (point, char, WHEELS):
            file.topic(kind._replace(md5sum=unknown)).write(T_NS, WHEELS_RAW)
    found = {c.topic: c.digest for c, _, _ in of_folder(tmp_path / "ride")}
    assert found == {"/point": point.md5sum, "/char": CHAR, "/wheels": unknown}


def test_a_message_of_ros_1_is_written_as_one_of_ros_2(tmp_path: Path) -> None:
    kind = declared(NOETIC, POINT, "/point")
    with bags.mcap(tmp_path / "a.mcap", ros2=True) as mcap, bags.folder(tmp_path / "ride") as folder:
        for file in (mcap, folder):
            write, form = file.topic(kind)
            write(T_NS, POINT_1)
            assert form.note == "of ROS 1, converted to ROS 2, without the seq of headers"
    profile, [(schema, channel, one)] = of_mcap(tmp_path / "a.mcap")
    assert (profile, schema.name, schema.encoding) == ("ros2", POINT, "ros2msg")
    assert (channel.metadata["topic_type_hash"], one.data) == (JAZZY.hash_rihs01(POINT), POINT_2)
    [(connection, t_ns, raw)] = of_folder(tmp_path / "ride")
    assert (connection.digest, t_ns, raw) == (JAZZY.hash_rihs01(POINT), T_NS, POINT_2)


def test_a_message_of_ros_2_is_written_into_a_bag_as_one_of_ros_1(tmp_path: Path) -> None:
    kind = declared(JAZZY, POINT, "/point")
    with bags.bag(tmp_path / "a.bag") as file:
        write, form = file.topic(kind)
        write(T_NS, POINT_2)
        # Fast DDS may reserve too much.
        write(T_NS, bytes(POINT_2) + bytes(8))
        write(
            T_NS + 1, JAZZY.serialize_cdr(JAZZY.deserialize_cdr(POINT_2, POINT), POINT, little_endian=False)
        )
    assert form.note == "of ROS 2, converted to ROS 1, with 0 as the seq of headers"
    with rosbag1.Reader(tmp_path / "a.bag") as reader:
        (connection,) = reader.connections
        raws = [raw for _, _, raw in reader.messages()]
    assert connection.digest == NOETIC.generate_msgdef(POINT)[1]
    assert raws == [bytes(4) + POINT_1[4:]] * 3


MARKER, CAMERA = "visualization_msgs/msg/Marker", "sensor_msgs/msg/CameraInfo"


def test_a_type_that_differs_becomes_the_one_of_that_name(tmp_path: Path) -> None:
    kind = declared(NOETIC, MARKER, "/marker")
    assert "mesh_file" not in kind.definition
    marker = default_message(NOETIC, MARKER)
    marker.text = "a"
    raw = NOETIC.serialize_ros1(marker, MARKER)
    with bags.mcap(tmp_path / "a.mcap", ros2=True) as file:
        write, form = file.topic(kind)
        write(T_NS, bytes(raw))
    assert form.note.endswith(", fields by name")
    _, [(schema, _, one)] = of_mcap(tmp_path / "a.mcap")
    assert "mesh_file" in schema.data.decode()
    assert JAZZY.deserialize_cdr(one.data, MARKER).text == "a"


def test_names_of_types_and_fields_become_the_other_ross(tmp_path: Path) -> None:
    text = "geometry_msgs/TransformStamped[] transforms\n"
    nested = "geometry_msgs/msg/TransformStamped"
    text += f"{LINE}MSG: geometry_msgs/TransformStamped\n{declared(NOETIC, nested, '/t').definition}"
    tf = MessageType("tf", "/tf", "tf/tfMessage", "9" * 32, text)
    camera = declared(NOETIC, CAMERA, "/camera")
    with bags.mcap(tmp_path / "a.mcap", ros2=True) as file:
        file.topic(tf).write(T_NS, bytes(4))
        form = file.topic(camera).form
    assert (" D\n" in camera.definition, " d\n" in form.definition) == (True, True)
    _, [(schema, _, one)] = of_mcap(tmp_path / "a.mcap")
    assert (schema.name, one.data) == ("tf2_msgs/msg/TFMessage", b"\0\1\0\0" + bytes(4))


def test_a_type_that_only_one_ros_has_goes_by_its_own_definition(tmp_path: Path) -> None:
    text = (
        "Header header\nuint8 MOST=3\nstd_msgs/Empty none\nPart[] parts\ntime at\n"
        f"{LINE}MSG: std_msgs/Header\nuint32 seq\ntime stamp\nstring frame_id\n"
        f"{LINE}MSG: std_msgs/Empty\n{LINE}MSG: lab_msgs/Part\nfloat64 x\nstring name\n"
    )
    name = "lab_msgs/msg/Own"
    ros1, ros2 = get_typestore(Stores.EMPTY), get_typestore(Stores.ROS2_JAZZY)
    ros1.register(get_types_from_msg(text, name))
    own = {name: fields for name, fields in ros1.fielddefs.items() if name.startswith("lab_msgs")}
    ros2.register(own)
    made = [
        (
            header(store, **seq),
            store.types["std_msgs/msg/Empty"](),
            [store.types["lab_msgs/msg/Part"](x=i / 3, name="ü" * i) for i in range(3)],
            store.types["builtin_interfaces/msg/Time"](5, 6),
        )
        for store, seq in ((ros1, {"seq": 3}), (ros2, {}))
    ]
    raw, want = (
        ros1.serialize_ros1(ros1.types[name](*made[0]), name),
        ros2.serialize_cdr(ros2.types[name](*made[1]), name),
    )
    kind = MessageType("own", "/own", "lab_msgs/Own", ros1.generate_msgdef(name)[1], text)
    with bags.mcap(tmp_path / "a.mcap", ros2=True) as file:
        file.topic(kind).write(T_NS, raw)
    _, [(schema, _, one)] = of_mcap(tmp_path / "a.mcap")
    assert one.data == want
    assert "uint8 MOST=3" in schema.data.decode()


@given(of_some_definition())
def test_any_message_of_ros_1_has_the_same_fields_in_ros_2_and_back(
    made: tuple[Message, list[bytes]],
) -> None:
    ros1, sent = made
    assume("[0]" not in ros1.definition)
    # A byte of ROS 2 has no sign.
    text = re.sub(r"\bbyte\b", "int8", ros1.definition)
    kind = MessageType("s", "/t", ros1.kind, "", text)
    there = form_of(kind, ros2=True)
    back = form_of(kind._replace(kind=there.kind, definition=there.definition), ros2=False)
    one = Decoder(parse(ros1.kind, text))
    two = Decoder(parse(there.kind, there.definition))
    for raw in sent:
        fields = one.decode(raw)
        assert _told(two.decode(there.convert(raw))) == _told(fields)
        assert _told(one.decode(back.convert(there.convert(raw)))) == _told(fields)


def _told(fields: Mapping[str, Any]) -> dict[str, str]:
    """The fields that both ROS have. Seconds of ROS 2 have a sign; a NaN equals a NaN."""
    return {
        name: repr(value % 2**32 if name.endswith("sec") and type(value) is int else value)
        for name, value in fields.items()
        if name.rpartition(".")[2] != "seq"
    }


def test_what_ros_2_cannot_have_is_named() -> None:
    kind = MessageType("s", "/t", "lab_msgs/None", "", "uint8[0] none\n")
    with pytest.raises(
        StationError, match=r"lab_msgs/None cannot be .* ROS 2: it has an array of no elements"
    ):
        form_of(kind, ros2=True)


def test_what_was_converted_when_it_was_recorded_is_converted_back(tmp_path: Path) -> None:
    """Recordings of before: the type is ROS 2's own, even one that another distribution has otherwise."""
    text = declared(NOETIC, POINT, "/point").definition + "\n"
    kind = MessageType("point", "/point", "geometry_msgs/PointStamped", "", text, ROS2)
    with bags.mcap(tmp_path / "a.mcap") as mcap, bags.bag(tmp_path / "a.bag") as bag:
        for file in (mcap, bag):
            file.topic(kind).write(T_NS, POINT_1)
        notes = [file.topic(kind).form.note for file in (mcap, bag)]
    assert notes == [
        "of ROS 2, converted to ROS 1 when they were recorded and back for this file",
        "of ROS 2, converted to ROS 1 when they were recorded",
    ]
    profile, [(schema, _, one)] = of_mcap(tmp_path / "a.mcap")
    assert (profile, schema.encoding, one.data) == ("ros2", "ros2msg", POINT_2)
    with rosbag1.Reader(tmp_path / "a.bag") as reader:
        assert [raw for _, _, raw in reader.messages()] == [POINT_1]


def test_an_mcap_may_have_messages_of_both(tmp_path: Path) -> None:
    kind = declared(NOETIC, POINT, "/point")
    with bags.mcap(tmp_path / "a.mcap") as file:
        file.topic(kind).write(T_NS, POINT_1)
        file.topic(WHEELS._replace(topic="/point")).write(T_NS, WHEELS_RAW)
    profile, found = of_mcap(tmp_path / "a.mcap")
    assert profile == ""
    assert [(s.encoding, c.topic, one.data) for s, c, one in found] == [
        ("ros1msg", "/point", POINT_1),
        ("ros2msg", "/point", WHEELS_RAW),
    ]


OTHER = WHEELS._replace(kind="lab_msgs/msg/Other")
REBUILT = WHEELS._replace(definition="int8 x\n", md5sum="RIHS01_" + "6" * 64)


@pytest.mark.parametrize(
    ("second", "why"),
    [
        (OTHER, "/wheels has messages of lab_msgs/msg/Wheels and lab_msgs/msg/Other"),
        (REBUILT, "lab_msgs/msg/Wheels has two definitions"),
        (REBUILT._replace(topic="/w"), "lab_msgs/msg/Wheels has two definitions"),
    ],
)
def test_a_folder_refuses_what_only_an_mcap_can_hold(tmp_path: Path, second: MessageType, why: str) -> None:
    def both(file: bags.Recording) -> None:
        for kind in (WHEELS, second):
            file.topic(kind).write(T_NS, WHEELS_RAW)

    with pytest.raises(StationError, match=f"{why}.*an .mcap can"), bags.folder(tmp_path / "ride") as folder:
        both(folder)
    assert list(tmp_path.iterdir()) == []
    with bags.mcap(tmp_path / "a.mcap") as mcap:
        both(mcap)
    assert [schema.data.decode() for schema, _, _ in of_mcap(tmp_path / "a.mcap")[1]] == [
        WHEELS.definition,
        second.definition,
    ]


def test_what_the_other_ros_cannot_have_is_named(tmp_path: Path) -> None:
    with bags.bag(tmp_path / "a.bag") as file:
        with pytest.raises(StationError, match=r"lab_msgs/msg/Wheels cannot be .* ROS 1.*an \.mcap has it"):
            file.topic(WHEELS)
        write = file.topic(declared(JAZZY, POINT, "/point")).write
        with pytest.raises(ConversionError, match="a message does not fit geometry_msgs/msg/PointStamped"):
            write(T_NS, POINT_2[:-3])
        write(T_NS, POINT_2)


def test_a_folder_replaces_a_recording_alone(tmp_path: Path) -> None:
    path = tmp_path / "ride"
    for force in (False, True):
        with bags.folder(path, force=force) as file:
            file.topic(WHEELS).write(T_NS, np.random.default_rng().bytes(10))
    (raw,) = (raw for _, _, raw in of_folder(path))
    with pytest.raises(StationError, match="broke off"), bags.folder(path, force=True):
        raise StationError("broke off")
    assert [found for _, _, found in of_folder(path)] == [raw]
    (path / "metadata.yaml").unlink()
    with pytest.raises(StationError, match="no recording"), bags.folder(path, force=True):
        pass
    assert (path / "ride.db3").exists()
