"""An export returns a ROS 1 publisher's messages byte for byte, for any definition and any values."""

from __future__ import annotations

import struct
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from threading import Event
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from mcap.reader import make_reader
from rosbags.rosbag1 import Reader
from rosbags.typesys import Stores, get_typestore

from iort_agent.lanes.streams import BatchEncoder
from iort_agent.sources import Emit
from iort_agent.sources.intake import Intake, TopicConfig
from iort_agent.sources.recording import BagConfig
from iort_agent.spool.memory import MemorySpool
from iort_contract.topics import RECORD, build_topic
from iort_station.data import bags
from iort_station.data.export import write
from iort_station.data.selection import select
from testkit.agent import ManualClock
from testkit.dynamodb import TELEMETRY, item_of_message
from testkit.ros1_types import HEADER, MESSAGES, Message, fields, header
from tests.ros1_strategies import definitions, messages
from tests.unit.agent.sources.test_bag import write_mcap, write_ros2
from tests.unit.station.data.test_data import cloud_of

T0_US = 1_700_000_000_000_000
STEP_S = 0.01


def stored(play: Callable[[Emit, ManualClock], None]) -> Any:
    """The cloud after a source, batches and queue; all but the network."""
    clock, spool = ManualClock(now_us=T0_US), MemorySpool(max_bytes=2**30)
    encoders: dict[str, BatchEncoder] = {}

    def emit(stream: str, t_us: int, values: Any) -> None:
        if stream not in encoders:
            boot = "0badcafe0badcafe"
            encoders[stream] = BatchEncoder(stream, boot=boot, batch_s=1, spool=spool, clock=clock)
        encoders[stream].add(t_us, values)

    play(emit, clock)
    for encoder in encoders.values():
        encoder.flush()
    cloud, at = cloud_of(), 0
    while entry := spool.next(at):
        at = entry.id
        topic = build_topic(RECORD, "car", entry.stream)
        cloud.table.put(TELEMETRY, item_of_message(entry.payload, topic))
    return cloud


def round_trip(definition: Message, sent: Sequence[bytes]) -> list[bytes]:
    """The messages after the source, batches, queue, table and export; all but the network."""

    def play(emit: Emit, clock: ManualClock) -> None:
        intake = Intake("/made", TopicConfig(stream="made", time="arrival"), emit=emit, clock=clock)
        connection = {
            "callerid": "/maker",
            "type": definition.kind,
            "md5sum": definition.md5sum,
            "message_definition": definition.definition,
        }
        for message in sent:
            intake.take(connection, message)
            clock.advance(STEP_S)

    cloud = stored(play)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "made.bag"
        with bags.bag(path) as file:
            write(cloud, select("car", "made"), file)
        with Reader(path) as reader:
            assert {(c.topic, c.digest) for c in reader.connections} == {("/made", definition.md5sum)}
            return [bytes(raw) for _, _, raw in reader.messages()]


def of_some_definition(most: int = 4) -> st.SearchStrategy[tuple[Message, list[bytes]]]:
    return definitions().flatmap(
        lambda made: st.tuples(st.just(made), st.lists(messages(made), min_size=1, max_size=most))
    )


NAMES = Message("a_msgs/Names", {"a_msgs/Names": "string[] names"})
SIGNED = Message("a_msgs/Signed", {"a_msgs/Signed": "byte[] signed"})
EMPTY = Message("std_msgs/Empty", {"std_msgs/Empty": ""})
NESTED = Message(
    "a_msgs/Path", {"a_msgs/Path": "Header header\nPose[] poses", "a_msgs/Pose": "Header header\nfloat64 x"}
)
OWN = Message("a_msgs/Own", {"a_msgs/Own": "Packet header\nuint8 u", "a_msgs/Packet": "uint16 id"})
BARE = Message(HEADER, {})
ROSOUT = b"\1\0\0\0\7\0\0\0/rosout"
NONE = bytes(4)


# Cases that need special care, by name.
KNOWN = {
    "an array of variable length": (NAMES, [ROSOUT, NONE, b"\2" + ROSOUT[1:] + bytes(4)]),
    "a byte is signed": (SIGNED, [b"\2\0\0\0\xff\x80", NONE]),
    "no field": (EMPTY, [b"", b""]),
    "a header within": (NESTED, [header(1, T0_US, b"map") + b"\1\0\0\0" + header(7, 42, b"\xff") + bytes(8)]),
    "a header of its own": (OWN, [b"\x05\0\7", b"\x06\0\7"]),
    "a header alone": (BARE, [header(9, T0_US, b"laser")]),
}


@pytest.mark.parametrize("made", KNOWN.values(), ids=KNOWN)
def test_a_message_is_exported_as_it_was_published(made: tuple[Message, list[bytes]]) -> None:
    _assert_exported(*made)


@given(of_some_definition())
def test_any_message_is_exported_as_it_was_published(made: tuple[Message, list[bytes]]) -> None:
    _assert_exported(*made)


def _assert_exported(definition: Message, sent: list[bytes]) -> None:
    came = round_trip(definition, sent)
    assert came == sent, [
        (fields(definition, one), fields(definition, other)) for one, other in zip(came, sent, strict=False)
    ]


def test_the_types_written_by_hand_have_ross_checksums() -> None:
    """The known types have ROS' checksums; the others are computed by the same rule."""
    store, known = get_typestore(Stores.ROS1_NOETIC), 0
    for message in MESSAGES.values():
        name = message.kind.replace("/", "/msg/")
        if name in store.fielddefs:
            known += 1
            assert store.generate_msgdef(name, ros_version=1)[1] == message.md5sum, message.kind
    assert known >= 10


# A type of ROS 2 has a byte if it has no field.
PAIR = (
    "/pair",
    "lab_msgs/msg/Pair",
    (
        f"std_msgs/Empty e\nfloat64 x\n{'=' * 80}\n"
        "MSG: std_msgs/Empty\nuint8 structure_needs_at_least_one_member\n"
    ),
    b"\0\1\0\0" + bytes(8) + struct.pack("<d", 1.5),
)


@pytest.mark.parametrize("topic", ["/sensors/core", "/odd", "/pair"])
def test_what_ros_2_recorded_is_exported_in_its_form(tmp_path: Path, topic: str) -> None:
    if topic == "/pair":
        source = write_mcap(tmp_path / "drive.mcap", PAIR)
    else:
        source = next(write_ros2(tmp_path / "drive", "mcap").glob("*.mcap"))

    def play(emit: Emit, clock: ManualClock) -> None:
        BagConfig(path=source, topics=((topic, "made"),)).build(clock).run(emit, Event())

    cloud, path = stored(play), tmp_path / "made.mcap"
    lines: list[str] = []
    with bags.mcap(path) as file:
        write(cloud, select("car", "made"), file, say=lines.append)
    assert "of ROS 2, converted to ROS 1 when they were recorded and back for this file" in lines[0]
    assert read_ros2(path, topic) == read_ros2(source, topic)
    with bags.bag(tmp_path / "made.bag") as bag:
        write(cloud, select("car", "made"), bag, say=lines.append)
    assert lines[-1].endswith("of ROS 2, converted to ROS 1 when they were recorded")


def read_ros2(path: Path, topic: str) -> list[tuple[str, str, str, bytes]]:
    """Type, encodings and bytes of a topic's messages in an MCAP file of ROS 2."""
    with path.open("rb") as file:
        reader = make_reader(file)
        assert reader.get_header().profile == "ros2"
        return [
            (schema.name, schema.encoding, channel.message_encoding, message.data)
            for schema, channel, message in reader.iter_messages(topics=[topic])
        ]
