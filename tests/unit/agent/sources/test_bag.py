"""Recordings: a real car's, and ROS 1 and ROS 2 ones written here."""

from __future__ import annotations

import hashlib
import struct
import threading
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Tuple

import numpy as np
import pytest
import yaml
from rosbags import rosbag2
from rosbags.rosbag1 import Writer as Writer1
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from iort_agent.errors import SourceError
from iort_agent.sources import FAIL, OK
from iort_agent.sources.recording import BagConfig
from iort_contract.catalog.streams import TYPES_STREAM
from iort_contract.catalog.vesc import VESC_FIELDS
from iort_contract.recordings.rosbag import VESC_STATE_ROS2, VESC_TYPE
from iort_contract.ros.message import message_type, type_id
from testkit.agent import ManualClock
from tests.recordings import recording
from tests.unit.contract.ros.ros1_messages import LINE

NOW = 1_700_000_000_000_000
# When the written recordings start, in nanoseconds.
START = 1_600_000_000_000_000_000

# The newest rosbags for Python 3.8 writes ROS 2 recordings in one format only.
STORAGES = ["mcap", "sqlite3"] if hasattr(rosbag2, "StoragePlugin") else ["sqlite3"]


Sample = Tuple[str, int, Any]


def play(path: Path, clock: ManualClock | None = None, **settings: Any) -> list[Sample]:
    """The samples, without what says what they are made of."""
    return [s for s in play_all(path, clock, **settings) if s[0] != TYPES_STREAM]


def play_all(path: Path, clock: ManualClock | None = None, **settings: Any) -> list[Sample]:
    out: list[Sample] = []
    source = BagConfig(path=path, **settings).build(clock or ManualClock(now_us=NOW))
    source.run(lambda *sample: out.append(sample), threading.Event())
    return out


def test_the_first_message_of_a_topic_brings_its_type(tmp_path: Path) -> None:
    first, second, *rest = play_all(write_ros1(tmp_path / "a.bag"))
    kind = message_type(first[2])
    assert first[:2] == (TYPES_STREAM, second[1])
    assert (kind.stream, kind.kind) == (second[0], "vesc_msgs/VescStateStamped")
    assert kind.id == second[2].kind.id
    assert "float64 speed" in kind.definition
    assert len(kind.md5sum) == 32
    assert TYPES_STREAM not in {sample[0] for sample in rest}


def test_a_type_that_was_rebuilt_while_recording_is_two_types(tmp_path: Path) -> None:
    path, kind = tmp_path / "a.bag", "lab_msgs/msg/State"
    definitions = ["float32 x\n", "int32 x\nint32 more\n"]
    with Writer1(path) as writer:
        for i, definition in enumerate(definitions):
            store = get_typestore(Stores.EMPTY)
            store.register(get_types_from_msg(definition, kind))
            md5sum = store.generate_msgdef(kind, ros_version=1)[1]
            connection = writer.add_connection(
                "/state", kind, msgdef=definition, md5sum=md5sum, callerid=f"/node_{i}"
            )
            writer.write(connection, START + i, (b"\0\0\x80?", bytes(range(8)))[i])
    types, samples = [], []
    for stream, _, values in play_all(path, topics=(("/state", "state"),)):
        (types if stream == TYPES_STREAM else samples).append(values)
    assert [message_type(said).definition for said in types] == definitions
    assert [sample.kind.id for sample in samples] == [message_type(said).id for said in types]
    assert [dict(sample) for sample in samples] == [{"x": 1.0}, {"x": 0x03020100, "more": 0x07060504}]


@pytest.mark.parametrize("speed", [0.0, 1.0])
def test_what_is_played_is_what_was_recorded_byte_for_byte(tmp_path: Path, speed: float) -> None:
    from rosbags.rosbag1 import Reader

    path = write_ros1(tmp_path / "a.bag", frames=["laser", "laser", "map"])
    samples = play(path, topics=(("/servo", "servo"), ("/sensors/core", "car")), speed=speed)
    with Reader(path) as reader:
        recorded = [(connection.topic, bytes(raw)) for connection, _, raw in reader.messages()]
        checksums = {connection.topic: connection.digest for connection in reader.connections}
    streams = {"servo": "/servo", "car": "/sensors/core"}
    assert [(streams[stream], values.raw) for stream, _, values in samples] == recorded
    for stream, topic in streams.items():
        (kind,) = {values.kind for name, _, values in samples if name == stream}
        named = {"servo": "std_msgs/Float64", "car": "vesc_msgs/VescStateStamped"}[stream]
        assert kind.id == type_id(topic, named, checksums[topic])


def recorded_by_ros2(folder: Path, topic: str) -> tuple[Any, list[bytes]]:
    """A topic's connection and the bytes of its messages, as rosbags reads them."""
    with rosbag2.Reader(folder) as reader:
        (connection,) = (c for c in reader.connections if c.topic == topic)
        return connection, [bytes(raw) for _, _, raw in reader.messages(connections=[connection])]


@pytest.mark.parametrize("storage", STORAGES)
@pytest.mark.parametrize("topic", ["/sensors/core", "/odd"])
def test_what_ros_2_recorded_is_kept_byte_for_byte(tmp_path: Path, storage: str, topic: str) -> None:
    folder = write_ros2(tmp_path / "drive", storage)
    said, *samples = play_all(folder, topics=((topic, "made"),))
    kind, (connection, raws) = message_type(said[2]), recorded_by_ros2(folder, topic)
    assert (kind.topic, kind.kind, kind.converted_from) == (topic, connection.msgtype, "")
    assert kind.md5sum == connection.digest == ros2_store().hash_rihs01(connection.msgtype)
    assert kind.definition == getattr(connection.msgdef, "data", connection.msgdef)
    assert [values.raw for _, _, values in samples] == raws
    assert {values.kind.id for _, _, values in samples} == {kind.id}


@pytest.mark.parametrize("storage", STORAGES)
def test_original_stamps_of_ros_2_are_the_headers(tmp_path: Path, storage: str) -> None:
    samples = play(write_ros2(tmp_path / "drive", storage, late_ns=5_000_000), stamps="original")
    assert [t_us for _, t_us, _ in samples] == [START // 1000 + i * 100_000 - 5_000 for i in range(10)]


STATE_ROS1 = "int32 FAULT_CODE_NONE=0\nfloat64 speed\nint32 fault_code\n"


def write_ros1(
    path: Path,
    *,
    count: int = 10,
    stamps: Callable[[int], int] = lambda t: t - 5_000_000,
    frames: Sequence[str] = ("",),
) -> Path:
    """Messages at 10 Hz, a stamp 5 ms before each is recorded, and a second topic."""
    store = get_typestore(Stores.ROS1_NOETIC)
    store.register(get_types_from_msg(STATE_ROS1, "vesc_msgs/msg/VescState"))
    store.register(get_types_from_msg("Header header\nvesc_msgs/VescState state\n", VESC_TYPE))
    types = store.types
    with Writer1(path) as writer:
        core = writer.add_connection("/sensors/core", VESC_TYPE, typestore=store)
        extra = writer.add_connection("/servo", "std_msgs/msg/Float64", typestore=store)
        for i in range(count):
            at = START + i * 100_000_000
            sec, nanosec = divmod(stamps(at), 1_000_000_000)
            stamp = types["builtin_interfaces/msg/Time"](sec=sec, nanosec=nanosec)
            header = types["std_msgs/msg/Header"](
                seq=i, stamp=stamp, frame_id=frames[min(i, len(frames) - 1)]
            )
            state = types["vesc_msgs/msg/VescState"](speed=float(i), fault_code=0)
            message = types[VESC_TYPE](header=header, state=state)
            writer.write(core, at, store.serialize_ros1(message, VESC_TYPE))
            servo = types["std_msgs/msg/Float64"](data=i / 10)
            writer.write(extra, at + 1, store.serialize_ros1(servo, "std_msgs/msg/Float64"))
    return path


def ros2_store() -> Any:
    store = get_typestore(Stores.ROS2_HUMBLE)
    state = "vesc_msgs/msg/VescState"
    # As in the driver, with the constants that the agent's own definition leaves out.
    store.register(get_types_from_msg("int32 FAULT_CODE_NONE=0\n" + VESC_STATE_ROS2, state))
    store.register(get_types_from_msg(f"std_msgs/Header header\n{state} state\n", VESC_TYPE))
    store.register(get_types_from_msg("float64[3] xs\nfloat32[] ys\n", "lab_msgs/msg/Odd"))
    return store


def ros2_writer(path: Path, storage: str) -> rosbag2.Writer:
    if len(STORAGES) == 1:
        return rosbag2.Writer(path)
    return rosbag2.Writer(path, version=8, storage_plugin=rosbag2.StoragePlugin[storage.upper()])


def write_ros2(path: Path, storage: str, *, count: int = 10, late_ns: int = 0) -> Path:
    store = ros2_store()
    types = store.types
    names = [name for name, field in VESC_FIELDS.items() if 2 in field.ros]
    whole = {"displacement", "distance_traveled", "fault_code", "controller_id"}
    with ros2_writer(path, storage) as writer:
        core = writer.add_connection("/sensors/core", VESC_TYPE, typestore=store)
        odd = writer.add_connection("/odd", "lab_msgs/msg/Odd", typestore=store)
        for i in range(count):
            at = START + i * 100_000_000
            sec, nanosec = divmod(at - late_ns, 10**9)
            stamp = types["builtin_interfaces/msg/Time"](sec=sec, nanosec=nanosec)
            header = types["std_msgs/msg/Header"](stamp=stamp, frame_id="")
            values = {name: k + i if name in whole else k + i + 0.5 for k, name in enumerate(names)}
            state = types["vesc_msgs/msg/VescState"](**values)
            message = types[VESC_TYPE](header=header, state=state)
            writer.write(core, at, store.serialize_cdr(message, VESC_TYPE))
            arrays = types["lab_msgs/msg/Odd"](
                xs=np.array([1.0, 2.0, 3.0]), ys=np.array([i, 0.5], dtype=np.float32)
            )
            writer.write(odd, at, store.serialize_cdr(arrays, "lab_msgs/msg/Odd"))
    return path


def test_a_real_drive() -> None:
    samples = play(recording("f1tenth-motor-servo.bag"))
    assert len(samples) == 2244
    assert {stream for stream, _, _ in samples} == {"vesc"}
    expected = {name for name, field in VESC_FIELDS.items() if 1 in field.ros}
    assert all(set(values) == expected for _, _, values in samples)
    assert samples[0][2]["voltage_input"] == 11.7
    times = [t_us for _, t_us, _ in samples]
    assert times[0] == NOW
    assert times == sorted(set(times))
    assert 44.8e6 < times[-1] - times[0] < 44.9e6


def test_the_pace_is_the_recordings(tmp_path: Path) -> None:
    path = write_ros1(tmp_path / "a.bag")
    for speed, seconds in ((1.0, 0.9), (2.0, 0.45), (0.0, 0.0)):
        clock = ManualClock(now_us=NOW)
        samples = play(path, clock, speed=speed)
        assert clock.now_us() - NOW == pytest.approx(seconds * 1e6, abs=100)
        assert samples[-1][1] - NOW == pytest.approx(seconds * 1e6, abs=100)
        assert len(samples) == 10


def test_original_stamps_are_the_headers(tmp_path: Path) -> None:
    samples = play(write_ros1(tmp_path / "a.bag"), stamps="original")
    assert [t for _, t, _ in samples] == [START // 1000 + i * 100_000 - 5_000 for i in range(10)]


def test_a_stamp_of_1970_is_not_believed(tmp_path: Path) -> None:
    samples = play(write_ros1(tmp_path / "a.bag", stamps=lambda _: 7), stamps="original")
    assert samples[0][1] == START // 1000


def test_topics_and_streams_are_the_users_choice(tmp_path: Path) -> None:
    samples = play(write_ros1(tmp_path / "a.bag"), topics=(("/servo", "servo"), ("/sensors/core", "car")))
    assert [(stream, values) for stream, _, values in samples[:4]] == [
        ("car", {"speed": 0.0, "fault_code": 0}),
        ("servo", {"data": 0.0}),
        ("car", {"speed": 1.0, "fault_code": 0}),
        ("servo", {"data": 0.1}),
    ]


@pytest.mark.parametrize("stamps", ["now", "original"])
def test_a_loop_goes_on_in_time(tmp_path: Path, stamps: str) -> None:
    path = write_ros1(tmp_path / "a.bag", count=5)
    samples = play(path, loop=True, duration_s=1.2, stamps=stamps)
    assert [values["speed"] for _, _, values in samples[:7]] == [0, 1, 2, 3, 4, 0, 1]
    times = [t for _, t, _ in samples]
    assert times == sorted(set(times))
    # Two topics are recorded, one is played: a round of five lasts half a second all the same.
    assert [t - times[0] for t in times] == [i * 100_000 for i in range(12)]


def test_stops_when_asked(tmp_path: Path) -> None:
    path = write_ros1(tmp_path / "a.bag")
    stop = threading.Event()
    seen: list[Any] = []

    def emit(*sample: Any) -> None:
        seen.append(sample)
        stop.set()

    BagConfig(path=path).build(ManualClock()).run(emit, stop)
    assert len(seen) == 1


@pytest.mark.parametrize("storage", STORAGES)
@pytest.mark.parametrize("by_file", [False, True])
def test_ros_2(tmp_path: Path, storage: str, by_file: bool) -> None:
    folder = write_ros2(tmp_path / "drive", storage)
    path = next(p for p in folder.iterdir() if p.suffix in (".mcap", ".db3")) if by_file else folder
    samples = play(path)
    assert len(samples) == 10
    values = samples[3][2]
    expected = [name for name, field in VESC_FIELDS.items() if 2 in field.ros]
    assert sorted(values) == sorted(expected)
    assert values["voltage_input"] == expected.index("voltage_input") + 3.5
    assert values["fault_code"] == expected.index("fault_code") + 3
    arrays = play(path, topics=(("/odd", "odd"),))[2][2] if storage == "mcap" else None
    if arrays is not None:
        assert arrays == {"xs.0": 1.0, "xs.1": 2.0, "xs.2": 3.0, "ys.0": 2.0, "ys.1": 0.5}


def strip_definitions(folder: Path) -> None:
    """What Foxy and Humble write: a database without definitions."""
    import sqlite3

    with sqlite3.connect(next(folder.glob("*.db3"))) as database:
        database.execute("DELETE FROM message_definitions")
    database.close()


def test_ros_2_without_definitions_knows_the_vesc_but_not_the_labs_types(tmp_path: Path) -> None:
    folder = write_ros2(tmp_path / "drive", "sqlite3")
    _, raws = recorded_by_ros2(folder, "/sensors/core")
    strip_definitions(folder)
    said, *samples = play_all(folder)
    assert [values.raw for _, _, values in samples] == raws
    assert {values["voltage_input"] for _, _, values in samples} == {i + 0.5 for i in range(10)}
    assert "float64 voltage_input\n" in message_type(said[2]).definition
    with pytest.raises(SourceError, match=r"/odd is of type lab_msgs/msg/Odd, whose definition"):
        play(folder, topics=(("/odd", "odd"),))


def test_a_topic_that_is_not_there_gets_a_list_of_those_that_are(tmp_path: Path) -> None:
    path = write_ros1(tmp_path / "a.bag")
    with pytest.raises(SourceError) as raised:
        play(path, topics=(("/core", "vesc"),))
    for part in ("no topic /core", "/sensors/core (vesc_msgs/msg/VescStateStamped)", "/servo (std_msgs"):
        assert part in str(raised.value)


def test_a_recording_without_a_vesc_needs_topics(tmp_path: Path) -> None:
    store = get_typestore(Stores.ROS1_NOETIC)
    with Writer1(tmp_path / "a.bag") as writer:
        topic = writer.add_connection("/servo", "std_msgs/msg/Float64", typestore=store)
        servo = store.types["std_msgs/msg/Float64"](data=0.1)
        writer.write(topic, START, store.serialize_ros1(servo, "std_msgs/msg/Float64"))
    with pytest.raises(SourceError, match=r"no topic of type vesc_msgs.*/servo \(std_msgs/msg/Float64\)"):
        play(tmp_path / "a.bag")


def test_a_recording_cut_short_says_so(tmp_path: Path) -> None:
    path = write_ros1(tmp_path / "a.bag")
    path.write_bytes(path.read_bytes()[:-200])
    with pytest.raises(SourceError, match=r"a\.bag.*`rosbag reindex` mends"):
        play(path)


def described(folder: Path, change: Callable[[Any], None]) -> Path:
    """The folder with another description of its topics in metadata.yaml."""
    file = folder / "metadata.yaml"
    about = yaml.safe_load(file.read_text())
    for topic in about["rosbag2_bagfile_information"]["topics_with_message_count"]:
        change(topic)
    file.write_text(yaml.safe_dump(about))
    return folder


# As the recorders of Foxy to Humble wrote it.
QOS = """
- history: 3
  depth: 0
  reliability: 1
  durability: 2
  deadline: {sec: 9223372036, nsec: 854775807}
  lifespan: {sec: 9223372036, nsec: 854775807}
  liveliness: 1
  liveliness_lease_duration: {sec: 9223372036, nsec: 854775807}
  avoid_ros_namespace_conventions: false
"""


@pytest.mark.parametrize("storage", STORAGES)
def test_a_topic_is_read_whatever_metadata_yaml_says_of_its_qos(tmp_path: Path, storage: str) -> None:
    def change(topic: Any) -> None:
        topic["topic_metadata"]["offered_qos_profiles"] = QOS

    assert len(play(described(write_ros2(tmp_path / "drive", storage), change))) == 10


def refused(path: Path, **settings: Any) -> tuple[list[Sample], str, Any]:
    """The samples, the error after them, and the report, of a recording that is not read to the last message;
    `iort-agent check` says the same."""
    out: list[Sample] = []
    config = BagConfig(path=path, **settings)
    source = config.build(ManualClock(now_us=NOW))
    with pytest.raises(SourceError) as raised:
        source.run(lambda *sample: out.append(sample), threading.Event())
    return [s for s in out if s[0] != TYPES_STREAM], str(raised.value), source.report()


def test_messages_that_are_counted_and_not_there_are_told_by_topic(tmp_path: Path) -> None:
    def change(topic: Any) -> None:
        topic["message_count"] += 2

    path = described(write_ros2(tmp_path / "drive", STORAGES[0]), change)
    samples, error, report = refused(path)
    assert len(samples) == 10
    for part in ("topic /sensors/core: ", "10 messages", "has 12"):
        assert part in error
    assert report == {"/sensors/core": {"unread": 2}}
    # The rosbags for Python 3.8 takes metadata.yaml for the index, so only the end tells.
    told = [FAIL] if "mcap" in STORAGES else []
    assert [finding.level for finding in BagConfig(path=path).check("a")] == [*told, OK]


def write_mcap(
    path: Path, *topics: tuple[str, str, str, bytes], count: int = 1, form: str = "ros2msg", rihs01: str = ""
) -> Path:
    """An MCAP file with messages of each topic: its name, type, definition and bytes."""
    from mcap.writer import CompressionType, Writer

    with path.open("wb") as file:
        writer = Writer(file, chunk_size=100, compression=CompressionType.NONE)
        writer.start(profile="ros2", library="test")
        for topic, kind, definition, _ in topics:
            schema = writer.register_schema(kind, form, definition.encode())
            writer.register_channel(topic, "cdr", schema, {"topic_type_hash": rihs01} if rihs01 else {})
        for i in range(count):
            for channel, (_, _, _, raw) in enumerate(topics, 1):
                writer.add_message(channel, START + i, raw, START + i)
        writer.finish()
    return path


SERVO = ("/servo", "std_msgs/msg/Float64", "float64 data\n", b"\0\1\0\0" + bytes(8))


def needs_mcap(test: Any) -> Any:
    """Leave a test out, so that nothing skips, with the rosbags for Python 3.8: it needs metadata.yaml."""
    return test if "mcap" in STORAGES else None


@needs_mcap
def test_a_chunk_that_the_index_leaves_out_is_told(tmp_path: Path) -> None:
    path = write_mcap(tmp_path / "a.mcap", SERVO, count=20)
    content = bytearray(path.read_bytes())
    # The record of the last chunk in the summary becomes one that no reader knows.
    index = content.rindex(b"\x08" + (74).to_bytes(8, "little"))
    content[index] = 0x7F
    path.write_bytes(content)
    samples, error, report = refused(path, topics=(("/servo", "servo"),))
    lost = 20 - len(samples)
    assert 0 < lost < 20
    assert f"topic /servo: {20 - lost} messages were read, the index has 20" in error
    assert report == {"/servo": {"unread": lost}}


@needs_mcap
def test_a_topic_that_cannot_be_read_is_left_out_alone(tmp_path: Path) -> None:
    lost = ("/lost", "lab_msgs/msg/Lost", "Part part\n", b"\0\1\0\0\1")
    wide = ("/wide", "lab_msgs/msg/Wide", "wstring name\n", b"\0\1\0\0\1\0\0\0a\0\0\0")
    swapped = ("/swapped", SERVO[1], SERVO[2], b"\0\0\0\0?\xf0" + bytes(6))
    short = ("/short", SERVO[1], SERVO[2], b"\0\1\0\0" + bytes(2))
    kept = (SERVO, wide, swapped, short)
    path = write_mcap(tmp_path / "a.mcap", *kept, lost, count=3)
    topics = tuple((topic, topic[1:]) for topic, *_ in (*kept, lost))
    samples, error, report = refused(path, topics=topics)
    # As live ones, messages are kept whatever they hold.
    assert [values.raw for _, _, values in samples] == [raw for *_, raw in kept] * 3
    assert [dict(values) for _, _, values in samples[:4]] == [{"data": 0.0}, {"name": "a"}, {"data": 1.0}, {}]
    for part in ("/lost", "lab_msgs/Part is missing"):
        assert part in error
    assert report == {"/lost": {"unread": 3}}


@needs_mcap
def test_the_hash_that_an_mcap_has_beside_a_channel_is_read(tmp_path: Path) -> None:
    rihs01 = "RIHS01_" + "a1" * 32
    path = write_mcap(tmp_path / "a.mcap", SERVO, rihs01=rihs01)
    found = [values for stream, _, values in play_all(path, topics=(("/servo", "servo"),))]
    assert (message_type(found[0]).md5sum, found[1].raw) == (rihs01, SERVO[3])


@needs_mcap
def test_a_recording_without_hashes_tells_two_definitions_of_one_name_apart(tmp_path: Path) -> None:
    path = write_mcap(tmp_path / "a.mcap", SERVO, (*SERVO[:2], "float32 data\n", SERVO[3][:8]))
    said, first, said_next, second = (values for _, _, values in play_all(path, topics=(("/servo", "s"),)))
    kinds = [message_type(one) for one in (said, said_next)]
    assert [kind.definition for kind in kinds] == ["float64 data\n", "float32 data\n"]
    assert [kind.md5sum for kind in kinds] == [
        f"sha256_{hashlib.sha256(kind.definition.encode()).hexdigest()}" for kind in kinds
    ]
    assert [first.kind.id, second.kind.id] == [kind.id for kind in kinds]


@needs_mcap
def test_a_definition_of_idl_is_written_as_a_message(tmp_path: Path) -> None:
    part = 'module lab_msgs { module msg { struct Part { @unit(value="m") double x; }; }; };\n'
    whole = "module lab_msgs { module msg { struct Whole { lab_msgs::msg::Part part; long n; }; }; };\n"
    text = f"{LINE}IDL: lab_msgs/msg/Whole\n{whole}{LINE}IDL: lab_msgs/msg/Part\n{part}"
    raw = b"\0\1\0\0" + struct.pack("<di", 1.5, -7)
    path = write_mcap(tmp_path / "a.mcap", ("/whole", "lab_msgs/msg/Whole", text, raw), form="ros2idl")
    said, values = (values for _, _, values in play_all(path, topics=(("/whole", "whole"),)))
    assert (
        message_type(said).definition == f"lab_msgs/Part part\nint32 n\n{LINE}MSG: lab_msgs/Part\nfloat64 x\n"
    )
    assert (values.raw, dict(values)) == (raw, {"part.x": 1.5, "n": -7})


@needs_mcap
def test_bounded_texts_and_arrays_and_old_names_of_types_are_read(tmp_path: Path) -> None:
    kind, definition = "lab_msgs/msg/Named", "string<=22 name\nfloat64[<=4] xs\nstring<=5[<=3] tags\n"
    store = get_typestore(Stores.EMPTY)
    store.register(get_types_from_msg(definition, kind))
    message = store.types[kind](name="hi", xs=np.array([1.0, 2.0]), tags=["a"])
    raw = bytes(store.serialize_cdr(message, kind))
    old = ("/servo", "std_msgs/Float64", *SERVO[2:])
    path = write_mcap(tmp_path / "a.mcap", ("/named", kind, definition, raw), old)
    samples = play(path, topics=(("/named", "named"), ("/servo", "servo")))
    assert [(stream, dict(values)) for stream, _, values in samples] == [
        ("named", {"name": "hi", "xs.0": 1.0, "xs.1": 2.0, "tags.0": "a"}),
        ("servo", {"data": 0.0}),
    ]
