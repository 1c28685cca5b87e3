"""docs/reference/messages.md says what the code does: each side reads what the other writes."""

from __future__ import annotations

import base64
import json
import re
import struct
import zlib
from collections.abc import Mapping, Sequence
from typing import Any

import pytest

from iort_contract.codec import CODEC, DICTIONARY, ROS1_CODEC, ROS2_CODEC, inflate
from iort_contract.messages.batch import Batch, decode_batch, encode_batch
from iort_contract.ros.message import Messages, RosType
from testkit.ros1_types import Message
from tests.messages_page import EXAMPLES, PAGE
from tests.unit.contract.ros.ros2_messages import HEADER, Cdr

TIMES_US = [1_700_000_000_000_000, 1_700_000_000_020_000, 1_700_000_000_040_001]
NUMBERS, BREAK = "<dI?", b"\n"
MADE = Message("a_msgs/Made", {"a_msgs/Made": "Header header\nfloat64 speed\nuint32 count\nbool on"})
STAMPED = RosType("/made", MADE.kind, MADE.md5sum, MADE.definition)
TEXT = RosType("/text", "std_msgs/String", "1" * 32, "string data # a text\n")
ROS2_STAMPED = RosType(
    "/made",
    "a_msgs/msg/Made",
    "RIHS01_",
    f"std_msgs/Header header\nbool a\nfloat64 b\nuint32 c\nint8 d\n{HEADER}",
)
ROS2_TEXT = RosType("/text", "std_msgs/msg/String", "RIHS01_", "string data # a text\n")
UNREADABLE = RosType("/text", "std_msgs/String", "1" * 32, "no definition at all")


@pytest.fixture(scope="module")
def page() -> Mapping[str, Any]:
    """The names that the page's writer and reader define."""
    names: dict[str, Any] = {"DICTIONARY": DICTIONARY}
    for block in re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL):
        exec(block, names)
    return names


def batch_of(columns: Mapping[str, Sequence[Any]], messages: Messages | None = None) -> dict[str, Any]:
    batch = Batch("0badcafe", 7, TIMES_US, columns, 0, messages)
    return dict(json.loads(encode_batch(batch)))


def made(offsets_ns: Sequence[int], frames: Sequence[bytes]) -> list[bytes]:
    """Stamped numeric messages; each stamp is this many nanoseconds behind the sample's time."""
    made = []
    for i, (t_us, ns, frame) in enumerate(zip(TIMES_US, offsets_ns, frames, strict=True)):
        sec, nanosec = divmod(t_us * 1000 + ns, 10**9)
        head = struct.pack("<IIII", 5 + 2 * i, sec, nanosec, len(frame)) + frame
        made.append(head + struct.pack(NUMBERS, 4613.5 + i / 4, 2**32 - 1 - i, i == 1))
    return made


def body_of(batch: Batch) -> bytes:
    envelope = json.loads(encode_batch(batch))
    return inflate(envelope["samples"], envelope["codec"])


def test_the_pages_examples_are_valid_bodies_of_batches() -> None:
    times = [0, 20_000, 40_001]
    example = EXAMPLES["batch"]
    assert f"    {inflate(example['samples'], example['codec']).decode()}\n" in PAGE

    lone = Message("a/X", {"a/X": "Header header\nint32 a"})
    kind = RosType("/x", lone.kind, "0" * 32, lone.definition)
    raw = [
        struct.pack("<IIII3si", seq, 0, t_us * 1000 + ns, 3, b"map", 7)
        for seq, t_us, ns in zip((5, 6, 7), times, (0, 3, 6), strict=True)
    ]
    body = body_of(Batch("0badcafe", 7, times, {}, 0, Messages(kind.id, kind.layout, raw)))
    assert f"    {body.partition(BREAK)[2].decode()}\n" in PAGE

    kind = RosType("/x", "a/msg/X", "0" * 32, f"std_msgs/Header header\nint32 a\n{HEADER}")
    raw = [
        Cdr().header(0, t_us * 1000 + ns, "map").put("i", 7).data
        for t_us, ns in zip(times, (0, 3, 6), strict=True)
    ]
    body = body_of(Batch("0badcafe", 7, times, {}, 0, Messages(kind.id, kind.layout, raw)))
    assert f"    {body.partition(BREAK)[2].decode()}\n" in PAGE

    kind = RosType("/x", "std_msgs/String", "0" * 32, "string data\n")
    raw = [b"\2\0\0\0ab"] * 3
    body = body_of(Batch("0badcafe", 7, times, {}, 0, Messages(kind.id, kind.layout, raw)))
    assert f"    {body.split(BREAK)[1].decode()}\n" in PAGE


def test_the_pages_dictionary_is_the_codecs() -> None:
    (text,) = re.findall(r"<!-- dictionary -->\n```text\n(.*?)```", PAGE, re.DOTALL)
    assert text.replace("\n", "").encode() == DICTIONARY


@pytest.mark.parametrize(
    "values", [[1, 2.5, None], [7, 9, -1], ["x", True, 0.1], ["\u00e9", 2**64 - 1, -(2**63)]]
)
def test_the_pages_writer_writes_valid_batches(page: Mapping[str, Any], values: list[Any]) -> None:
    written = page["written"]("0badcafe", 7, TIMES_US, {"speed": values, "on": [True] * 3})
    assert decode_batch(written) == Batch("0badcafe", 7, TIMES_US, {"speed": values, "on": [True] * 3})
    assert page["opened"](json.loads(written))[1]["speed"] == values


def test_a_writer_may_leave_the_dictionary_out() -> None:
    batch = batch_of({"speed": [1, 2, 3]})
    body = inflate(batch["samples"], batch["codec"])
    plain = {**batch, "samples": base64.b64encode(zlib.compress(body)).decode()}
    assert decode_batch(json.dumps(plain)) == decode_batch(json.dumps(batch))


@pytest.mark.parametrize("speeds", [[1, 2.5, None], [4614, 4613.5, 4620.25], [7, 9, -1], ["x", True, 0.1]])
def test_the_pages_reader_reads_columns(page: Mapping[str, Any], speeds: list[Any]) -> None:
    batch = batch_of({"speed": speeds})
    assert page["opened"](batch) == (TIMES_US, {"speed": speeds}, b"")


@pytest.mark.parametrize(
    ("offsets_ns", "frames"),
    [([0, 7, 999], [b"map"] * 3), ([-1, 5000, 0], [b"map", b"", b"odom"]), ([-17 * 10**17, 0, 0], [b""] * 3)],
)
def test_the_pages_reader_restores_numeric_messages(
    page: Mapping[str, Any], offsets_ns: list[int], frames: list[bytes]
) -> None:
    raw = made(offsets_ns, frames)
    batch = batch_of({}, Messages(STAMPED.id, STAMPED.layout, raw))
    assert batch["codec"] == CODEC
    times_us, columns, behind = page["opened"](batch)
    assert json.loads(behind)[0] == STAMPED.id
    assert list(page["made_again"](times_us, columns, behind, NUMBERS)) == raw


@pytest.mark.parametrize(
    ("offsets_ns", "frames", "gap", "end"),
    [
        ([0, 7, 999], ["map"] * 3, b"\0", b""),
        ([-1, 5000, 0], ["map", "", "odom"], b"\0", b"abc"),
        ([-(TIMES_US[0] + 10**6) * 1000, 0, 0], [""] * 3, b"\x07", b""),
    ],
)
def test_the_pages_reader_restores_numeric_messages_of_ros_2(
    page: Mapping[str, Any], offsets_ns: list[int], frames: list[str], gap: bytes, end: bytes
) -> None:
    raw = []
    for i, (t_us, ns, frame) in enumerate(zip(TIMES_US, offsets_ns, frames, strict=True)):
        sec, nanosec = divmod(t_us * 1000 + ns, 10**9)
        cdr = Cdr().header(sec, nanosec, frame).put("B", i == 1)
        cdr.data += gap * (-(len(cdr.data) - 4) % 8)
        whole = cdr.put("d", 4613.5 + i / 4).put("I", 2**32 - 1 - i).put("b", -i).data
        raw.append(whole + end[: -len(whole) % 4])
    batch = batch_of({}, Messages(ROS2_STAMPED.id, ROS2_STAMPED.layout, raw))
    assert batch["codec"] == CODEC
    times_us, columns, behind = page["opened"](batch)
    assert list(page["made_again_of_ros2"](times_us, columns, behind, "?dIb")) == raw


def test_the_pages_reader_reads_messages_of_ros_2_as_they_were_published(page: Mapping[str, Any]) -> None:
    raw = [Cdr().text(text).data for text in ("ab", "", "abc")]
    batch = batch_of({}, Messages(ROS2_TEXT.id, ROS2_TEXT.layout, raw))
    assert batch["codec"] == ROS2_CODEC
    _, _, behind = page["opened"](batch)
    assert page["as_published"](batch["n"], behind) == raw


@pytest.mark.parametrize("kind", [TEXT, UNREADABLE])
@pytest.mark.parametrize("texts", [[b"ab", b"cd", b"\xff"], [b"ab", b"cd", b"ef"], [b"", b"abc", b""]])
def test_the_pages_reader_reads_messages_as_they_were_published(
    page: Mapping[str, Any], kind: RosType, texts: list[bytes]
) -> None:
    raw = [struct.pack("<I", len(text)) + text for text in texts]
    batch = batch_of({"data.key": ["a", None, "b"]}, Messages(kind.id, kind.layout, raw))
    assert batch["codec"] == ROS1_CODEC
    times_us, columns, behind = page["opened"](batch)
    assert (times_us, columns) == (TIMES_US, {"data.key": ["a", None, "b"]})
    assert page["as_published"](batch["n"], behind) == raw
    assert json.loads(behind.partition(b"\n")[0])["layout"] == kind.layout
