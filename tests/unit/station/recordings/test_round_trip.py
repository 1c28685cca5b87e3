"""An export returns a ROS 1 publisher's messages byte for byte, for any definition and any values."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from rosbags.rosbag1 import Reader
from rosbags.typesys import Stores, get_typestore

from iort_agent.lanes.batch_encoder import BatchEncoder
from iort_agent.sources.intake import Intake, TopicConfig
from iort_agent.spool.memory import MemorySpool
from iort_contract.topics import RECORD, build_topic
from iort_station.data.selection import select
from iort_station.recordings import recordings
from iort_station.recordings.export import write
from tests.agent_fakes import ManualClock
from tests.fakes import TELEMETRY, item_of_message
from tests.ros.mixed.robot import MESSAGES
from tests.ros1_strategies import definitions, messages
from tests.ros1_types import HEADER, Message, fields, header
from tests.unit.station.data.test_data import cloud_of

T0_US = 1_700_000_000_000_000
STEP_S = 0.01


def round_trip(definition: Message, sent: Sequence[bytes]) -> list[bytes]:
    """The messages after the source, batches, queue, table and export; all but the network."""
    clock, spool = ManualClock(now_us=T0_US), MemorySpool(max_bytes=2**30)
    encoders: dict[str, BatchEncoder] = {}

    def emit(stream: str, t_us: int, values: Any) -> None:
        if stream not in encoders:
            boot = "0badcafe0badcafe"
            encoders[stream] = BatchEncoder(stream, boot=boot, batch_s=1, spool=spool, clock=clock)
        encoders[stream].add(t_us, values)

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
    for encoder in encoders.values():
        encoder.flush()
    cloud, at = cloud_of(), 0
    while entry := spool.next(at):
        at = entry.id
        topic = build_topic(RECORD, "car", entry.stream)
        cloud.table.put(TELEMETRY, item_of_message(entry.payload, topic))
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "made.bag"
        with recordings.bag(path) as file:
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
