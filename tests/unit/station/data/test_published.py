"""Messages are exported from stored batches as they were published, or counted as missing."""

from __future__ import annotations

import hashlib

import pytest

from iort_contract.messages.batch import Batch
from iort_contract.messages.message_type import MessageType
from iort_contract.messages.requests.files import ATTACHMENT_FIELDS
from iort_contract.ros1.decode import Large
from iort_contract.ros1.message import Messages, RosType, cut
from iort_station.data.export import Export
from iort_station.data.selection import select
from testkit.dynamodb import TELEMETRY, item_of, serialize
from tests.unit.contract.ros1.ros1_messages import LINE, text, u32
from tests.unit.station.data.test_data import START, cloud_of

FLAT = RosType("/flat", "a_msgs/Flat", "1", "uint8 n")
NAMES = RosType("/names", "a_msgs/Names", "2", "string[] names")
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
    found, export = exported(of(NAMES, names, seq=1, at=50_000), of(FLAT, flat))
    assert found == [
        (0, FLAT.id, b"\1"),
        (100_000, FLAT.id, b"\2"),
        (50_000, NAMES.id, names[0]),
        (150_000, NAMES.id, names[1]),
    ]
    assert (export.others, export.empty, export.refused.count) == (0, 0, 0)


def test_a_missing_type_is_taken_from_the_batch():
    _, export = exported(of(NAMES, [u32(0)]))
    made = export.types[NAMES.id]
    assert (made.topic, made.kind, made.md5sum) == ("/vesc", "a_msgs/Names", "")
    assert made.definition == "string[] names\n"
    assert FLAT.id in export.types


def test_columns_of_an_unknown_type_are_refused_and_other_batches_are_exported():
    found, export = exported(of(FLAT, [b"\1"]), of(NAMES, [u32(0)], seq=1), types={})
    assert found == [(0, NAMES.id, u32(0))]
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
