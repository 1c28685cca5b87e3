"""Exports: messages as published, and the same samples there and back."""

from __future__ import annotations

import hashlib
import struct
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from threading import Event
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rosbags.highlevel import AnyReader
from rosbags.rosbag1 import Reader
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from iort_agent.lanes.streams import BatchEncoder
from iort_agent.sources import Emit
from iort_agent.sources.intake import Intake, TopicConfig
from iort_agent.sources.recording import BagConfig
from iort_contract.catalog.streams import TYPES_STREAM
from iort_contract.messages.batch import Batch
from iort_contract.messages.files import ATTACHMENT_FIELDS
from iort_contract.ros.decode import Decoder, Large
from iort_contract.ros.definition import parse
from iort_contract.ros.message import ROS2, Messages, MessageType, RosMessage, RosType, cut
from iort_contract.topics import RECORD, build_topic
from iort_station.data import bags
from iort_station.data.export import Export, write
from iort_station.data.recorded import select
from testkit.agent import ManualClock, MemorySpool
from testkit.dynamodb import TELEMETRY, item_of, item_of_message, serialize
from testkit.ros1_types import HEADER, MESSAGES, Message, fields, header
from tests.ros1_strategies import definitions, messages
from tests.unit.agent.sources.test_bag import write_mcap, write_ros2
from tests.unit.contract.ros.ros1_messages import LINE, text, u32
from tests.unit.station.data.test_queries import START, cloud_of

FLAT = RosType("/flat", "a_msgs/Flat", "1", "uint8 n")
PUBLISHED_NAMES = RosType("/names", "a_msgs/Names", "2", "string[] names")
IMAGE = RosType("/image", "a_msgs/Image", "3", "uint8[] a\nstring format\nuint8[] b")
SAID = {
    kind.id: MessageType("vesc", topic, name, md5sum, definition)
    for kind, (topic, name, md5sum, definition) in {
        FLAT: ("/flat", "a_msgs/Flat", "1", "uint8 n"),
        IMAGE: ("/image", "a_msgs/Image", "3", "uint8[] a\nstring format\nuint8[] b"),
    }.items()
}


def of(kind, raws, *, seq=0, at=0, step_us=100_000, **beside):
    times = [START + at + i * step_us for i in range(len(raws))]
    return Batch("0badcafe", seq, times, beside, 0, Messages(kind.id, kind.layout, raws))


def exported(*batches, types=SAID, start=None, end=None, content=lambda _key: None, change=None):
    cloud = cloud_of()
    for batch in batches:
        cloud.table.put(TELEMETRY, item_of(batch) | (change or {}))
    export = Export(cloud, select("car", "vesc", start, end), types, content)
    return [(t_us - START, type_id, raw) for t_us, type_id, raw in export.messages()], export


def test_messages_of_several_types_are_exported_in_the_order_of_their_batches():
    flat, names = [b"\1", b"\2"], [u32(1) + text("a"), u32(0)]
    found, export = exported(of(PUBLISHED_NAMES, names, seq=1, at=50_000), of(FLAT, flat))
    assert found == [
        (0, FLAT.id, b"\1"),
        (100_000, FLAT.id, b"\2"),
        (50_000, PUBLISHED_NAMES.id, names[0]),
        (150_000, PUBLISHED_NAMES.id, names[1]),
    ]
    assert (export.others, export.empty, export.refused.count) == (0, 0, 0)


def test_a_missing_type_is_taken_from_the_batch():
    _, export = exported(of(PUBLISHED_NAMES, [u32(0)]))
    made = export.types[PUBLISHED_NAMES.id]
    assert (made.topic, made.kind, made.md5sum) == ("/vesc", "a_msgs/Names", "")
    assert made.definition == "string[] names\n"
    assert FLAT.id in export.types


def test_columns_of_an_unknown_type_are_refused_and_other_batches_are_exported():
    found, export = exported(of(FLAT, [b"\1"]), of(PUBLISHED_NAMES, [u32(0)], seq=1), types={})
    assert found == [(0, PUBLISHED_NAMES.id, u32(0))]
    assert export.refused.count == 1
    assert f"the messages' type '{FLAT.id}' is unknown" in export.refused.reason


def test_a_range_includes_its_start_and_excludes_its_end():
    raws = [bytes([i]) for i in range(8)]
    found, _ = exported(of(FLAT, raws), start=START + 200_000, end=START + 500_000)
    assert [raw for _, _, raw in found] == raws[2:5]


def test_samples_without_messages_are_counted():
    plain = Batch("0badcafe", 1, [START, START + 1, START + 2], {"n": [1, 2, 3]})
    found, export = exported(of(FLAT, [b"\1"]), plain, end=START + 2)
    assert [raw for _, _, raw in found] == [b"\1"]
    assert export.others == 2


def test_an_invalid_batch_is_refused():
    found, export = exported(of(FLAT, [b"\1"]), change={"samples": serialize("!")})
    assert (found, export.refused.count) == ([], 1)
    assert "base64" in export.refused.reason


A = Large(b"a picture", 0)
B = Large(b"another picture", 4 + len(A) + len(text("jpeg")))
WHOLE = u32(len(A)) + A + text("jpeg") + u32(len(B)) + B


def attachment(field, at, key, content):
    """The columns beside a message after its content was cut out."""
    attachment = {name: [None] for name in ATTACHMENT_FIELDS}
    attachment |= {"key": [key], "sha256": [hashlib.sha256(content).hexdigest()], "at": [at]}
    return {f"{field}.{name}": column for name, column in attachment.items()}


def with_attachments(*, sha256_of_b=B, key_of_a="k/a"):
    """An image with two contents stored as files."""
    less, at_a = cut(WHOLE, A)
    less, at_b = cut(less, B, removed=len(A))
    beside = {**attachment("a", at_a, key_of_a, A), **attachment("b", at_b, "k/b", sha256_of_b)}
    return less, of(IMAGE, [less], **beside)


def test_contents_stored_as_files_are_restored_in_their_messages():
    _, batch = with_attachments()
    found, export = exported(batch, content={"k/a": A, "k/b": B}.get)
    assert found == [(0, IMAGE.id, WHOLE)]
    assert export.empty == 0


@pytest.mark.parametrize(
    ("files", "how", "left"),
    [
        ({}, {}, "both"),
        ({"k/a": A}, {}, "both"),
        ({"k/b": B}, {}, "a"),
        ({"k/a": A, "k/b": B}, {"sha256_of_b": b"something else"}, "both"),
        ({"k/a": A, "k/b": B}, {"key_of_a": None}, "a"),
    ],
)
def test_a_missing_content_leaves_an_empty_array_and_is_counted(files, how, left):
    less, batch = with_attachments(**how)
    found, export = exported(batch, content=files.get)
    assert [raw for _, _, raw in found] == [less if left == "both" else cut(WHOLE, A)[0]]
    assert export.empty == 1


@pytest.mark.parametrize("at", [None, 1.5, "4"])
def test_an_invalid_position_of_a_content_is_ignored(at):
    """A user's own field may have the same name."""
    found, export = exported(of(IMAGE, [WHOLE], **attachment("a", at, "k", b"")))
    assert [raw for _, _, raw in found] == [WHOLE]
    assert export.empty == 0


def test_a_field_of_the_message_itself_is_no_attachment():
    definition = "B b\n" + LINE + "MSG: a_msgs/B\nstring key\nint32 at\nuint8[] none\n"
    own = RosType("/own", "a_msgs/Own", "4", definition)
    raw = text("k") + u32(0) + u32(0)
    found, export = exported(of(own, [raw]), content={"k": A}.get)
    assert ([raw for _, _, raw in found], export.empty) == ([raw], 0)


@pytest.mark.parametrize("at", [-1, 1, 10**6])
def test_a_position_without_an_empty_array_is_refused_and_the_next_batch_is_read(at):
    """A hostile batch does not end an export."""
    beside = attachment("a", at, "k", A)
    found, export = exported(
        of(IMAGE, [WHOLE], **beside), of(FLAT, [b"\1"], seq=1, at=1), content={"k": A}.get
    )
    assert [raw for _, _, raw in found] == [b"\1"]
    assert export.refused.count == 1


T0_US = 1_700_000_000_000_000
STEP_S = 0.01


def stored(play: Callable[[Emit, ManualClock], None]) -> Any:
    """The cloud after a source, batches and queue; all but the network."""
    clock, spool = ManualClock(now_us=T0_US), MemorySpool(max_bytes=2**30)
    encoders: dict[str, BatchEncoder] = {}

    def emit(stream: str, t_us: int, values: Any, **_: bool) -> float:
        if stream not in encoders:
            boot = "0badcafe0badcafe"
            encoders[stream] = BatchEncoder(stream, boot=boot, batch_s=1, spool=spool, clock=clock)
        encoders[stream].add(t_us, values)
        return 0.0

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


def of_some_definition() -> st.SearchStrategy[tuple[Message, list[bytes]]]:
    return definitions().flatmap(
        lambda made: st.tuples(st.just(made), st.lists(messages(made), min_size=1, max_size=4))
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
def test_what_ros_2_recorded_is_exported_byte_for_byte(tmp_path: Path, topic: str) -> None:
    if topic == "/pair":
        source = write_mcap(tmp_path / "drive.mcap", PAIR)
    else:
        source = next(write_ros2(tmp_path / "drive", "mcap").glob("*.mcap"))

    def play(emit: Emit, clock: ManualClock) -> None:
        BagConfig(path=source, topics=((topic, "made"),)).build(clock).run(emit, Event())

    notes = notes_of(stored(play), tmp_path)
    assert notes[".mcap"] == notes[""] == ["as they were published"]
    assert "of ROS 2, converted to ROS 1" in notes[".bag"][0]
    want = of_ros2(source, topic)
    assert len(want) == (1 if topic == "/pair" else 10)
    assert of_ros2(tmp_path / "made.mcap", topic) == of_ros2(tmp_path / "made", topic) == want


def notes_of(cloud: Any, folder: Path) -> dict[str, list[str]]:
    """Export a stream into a file of each kind, and return what is said of its messages."""
    notes: dict[str, list[str]] = {}
    for ending, kind in bags.KINDS.items():
        lines: list[str] = []
        with kind(folder / f"made{ending}") as file:
            write(cloud, select("car", "made"), file, say=lines.append)
        notes[ending] = [line.partition(", ")[2] for line in lines]
    return notes


def of_ros2(path: Path, topic: str) -> list[tuple[str, str, bytes]]:
    """Type, definition and bytes of a topic's messages in a recording of ROS 2."""
    with AnyReader([path]) as reader:
        return [
            (connection.msgtype, connection.msgdef.data, bytes(raw))
            for connection, _, raw in reader.messages()
            if connection.topic == topic
        ]


# Recorded by an agent that made messages of ROS 1 of those of ROS 2.
OLD = MessageType("made", "/pair", "lab_msgs/Pair", "1" * 32, PAIR[2].rpartition("uint8")[0], ROS2)
_STORE = get_typestore(Stores.EMPTY)
_STORE.register(get_types_from_msg(PAIR[2], PAIR[1]))
NEW = MessageType("made", "/pair", PAIR[1], _STORE.hash_rihs01(PAIR[1]), PAIR[2])


def emitted(*messages: tuple[MessageType, bytes]) -> Any:
    """The cloud after these messages of a stream, ten a second, each kind with its type."""

    def play(emit: Emit, clock: ManualClock) -> None:
        kinds = {}
        for kind, raw in messages:
            if kind not in kinds:
                kinds[kind] = RosType(kind.topic, kind.kind, kind.md5sum, kind.definition)
                emit(TYPES_STREAM, clock.now_us(), kind.sample())
            emit("made", clock.now_us(), RosMessage(raw, kinds[kind]))
            clock.advance(0.1)

    return stored(play)


def test_a_stream_may_have_messages_that_were_converted_and_later_ones_that_were_not(tmp_path: Path) -> None:
    raw = PAIR[3]
    notes = notes_of(emitted((OLD, raw[12:]), (NEW, raw), (NEW, raw)), tmp_path)
    before = "of ROS 2, converted to ROS 1 when they were recorded"
    assert notes[".mcap"] == [f"{before} and back for this file", "as they were published"]
    assert notes[".bag"] == [before, "of ROS 2, converted to ROS 1"]
    for path in ("made.mcap", "made"):
        assert [found[2] for found in of_ros2(tmp_path / path, "/pair")] == [raw] * 3


def test_a_message_that_cannot_be_converted_is_left_out_and_counted(tmp_path: Path) -> None:
    notes = notes_of(emitted((NEW, PAIR[3]), (NEW, PAIR[3][:9]), (NEW, PAIR[3])), tmp_path)
    assert notes[".mcap"] == ["as they were published"]
    with Reader(tmp_path / "made.bag") as reader:
        assert reader.message_count == 2
    assert len(of_ros2(tmp_path / "made.mcap", "/pair")) == 3


def test_samples_of_ros_2_become_messages_of_it_and_so_do_those_beside_them(tmp_path: Path) -> None:
    name, jazzy = "geometry_msgs/msg/PointStamped", get_typestore(Stores.ROS2_JAZZY)
    text, _ = jazzy.generate_msgdef(name, ros_version=2)
    kind = MessageType("made", "/point", name, jazzy.hash_rihs01(name), text)

    def play(emit: Emit, clock: ManualClock) -> None:
        emit(TYPES_STREAM, clock.now_us(), kind.sample())
        for n in range(3):
            emit("made", clock.now_us(), {"x": n / 4, "z": None})
            # Its fields change.
            emit("rtt-2", clock.now_us(), {"ms": n / 2} if n < 2 else {"ms": 1.0, "lost": n})
            clock.advance(2)

    cloud = stored(play)
    for ending, make in bags.KINDS.items():
        with make(tmp_path / f"ride{ending}") as file:
            lines: list[str] = []
            for stream in ("made", "rtt-2"):
                write(cloud, select("car", stream), file, say=lines.append)
        middle = "/" if ending == ".bag" else "/msg/"
        assert (
            lines[0]
            == f"car made: 3 messages of geometry_msgs{middle}PointStamped on /point, made of samples"
        )
        assert (
            lines[2]
            == f"car rtt-2: 3 messages of iort_msgs{middle}Rtt_2_2 on /rtt_2, /rtt_2_2, made of samples"
        )
        assert lines[4] == "its fields changed, so there are 2 types, each on a topic of its own"
        with AnyReader([tmp_path / f"ride{ending}"]) as reader:
            found = [(c.topic, reader.deserialize(raw, c.msgtype)) for c, _, raw in reader.messages()]
        points = [message for topic, message in found if topic == "/point"]
        assert [(one.point.x, np.isnan(one.point.z)) for one in points] == [
            (0, True),
            (0.25, True),
            (0.5, True),
        ]
        assert [one.header.stamp.sec - T0_US // 1_000_000 for one in points] == [0, 2, 4]
        assert [message.ms for topic, message in found if topic.startswith("/rtt_2")] == [0, 0.5, 1]
        assert [message.lost for topic, message in found if topic == "/rtt_2_2"][-1] == 2


def test_contents_stored_as_files_are_restored_in_messages_of_ros_2() -> None:
    text = "uint8[] a\nfloat64 x\nstring format\nuint8[] b"
    kind, store = RosType("/image", "a_msgs/msg/Image", "4", text), get_typestore(Stores.EMPTY)
    store.register(get_types_from_msg(text, "a_msgs/msg/Image"))
    a, b = np.frombuffer(A, np.uint8), np.frombuffer(B, np.uint8)
    message = store.types["a_msgs/msg/Image"](a=a, x=1.5, format="jpeg", b=b)
    whole = bytes(store.serialize_cdr(message, "a_msgs/msg/Image"))
    contents = Decoder(parse("a_msgs/msg/Image", text), large=True).decode(whole)
    less, at_a = cut(whole, contents["a"], ros2=True)
    less, at_b = cut(less, contents["b"], len(whole) - len(less), ros2=True)
    beside = {**attachment("a", at_a, "k/a", A), **attachment("b", at_b, "k/b", B)}
    types = {kind.id: MessageType("vesc", "/image", "a_msgs/msg/Image", "4", text)}
    found, export = exported(of(kind, [less], **beside), types=types, content={"k/a": A, "k/b": B}.get)
    assert (found, export.empty) == ([(0, kind.id, whole)], 0)
    assert len(less) < len(whole)
