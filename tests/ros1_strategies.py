"""Hypothesis strategies: any ROS 1 message definition, and any messages of it."""

from __future__ import annotations

import struct

from hypothesis import strategies as st

from testkit.ros1_types import HEADER, SIZES, STRING, Message, serialize

_BUILTIN = (*SIZES, STRING)
# Field names of real packages, and names that a decoder may use itself.
_NAMES = st.sampled_from(
    [
        "header",
        "data",
        "stamp",
        "frame_id",
        "seq",
        "sec",
        "nanosec",
        "name",
        "x",
        "f0",
        "Accel",
        "state",
        "status",
    ]
)
_ARRAYS = st.sampled_from(["", "", "", "[]", "[]", "[0]", "[1]", "[3]"])
_CONSTANTS = ("uint8 LEFT=0", "string WHO=a # b", "float32 PI=3.14", "bool TRUE=True", "int64 LOW=-1")
_EDGES = {
    "float32": [struct.pack("<f", value) for value in (0.0, -0.0, 1.5, float("inf"), float("nan"), 3.4e38)],
    "float64": [struct.pack("<d", value) for value in (0.0, -0.0, 0.1, float("-inf"), float("nan"), 5e-324)],
    "uint64": [struct.pack("<Q", value) for value in (2**53 + 1, 2**63, 2**64 - 1)],
    "int64": [struct.pack("<q", value) for value in (-(2**63), 2**53 + 1)],
    "bool": [b"\0", b"\1"],
}
_TEXTS = st.one_of(
    st.sampled_from([b"", b"base_link", "grün".encode(), b"\xff\xfe", b"\xc3", b"a\0b", b"nan"]),
    st.binary(max_size=12),
)


def _numbers(kind: str) -> st.SearchStrategy[bytes]:
    size, edges = SIZES[kind], st.sampled_from(_EDGES.get(kind, [bytes(SIZES[kind]), b"\xff" * SIZES[kind]]))
    return edges if kind == "bool" else st.one_of(edges, st.binary(min_size=size, max_size=size))


_NUMBERS = {kind: _numbers(kind) for kind in SIZES}


@st.composite
def _text(draw: st.DrawFn, within: list[str], *, headed: bool) -> str:
    """Draw one type's own text, with builtin types and those of ``within``."""
    lines = draw(st.lists(st.sampled_from(_CONSTANTS), max_size=2, unique=True))
    names = draw(st.lists(_NAMES, max_size=5, unique=True))
    if headed:
        lines.append("Header header")
        names = [name for name in names if name != "header"]
    kinds = st.sampled_from([*_BUILTIN, HEADER, *within, *within])
    return "\n".join([*lines, *(f"{draw(kinds)}{draw(_ARRAYS)} {name}" for name in names)])


@st.composite
def definitions(draw: st.DrawFn) -> Message:
    """Draw a message type: nested or flat, with or without a header, possibly without fields."""
    texts: dict[str, str] = {}
    for name in draw(st.sampled_from([[], ["Part"], ["Part", "Whole"]])):
        texts[f"made_msgs/{name}"] = draw(_text(list(texts), headed=draw(st.booleans())))
    texts["made_msgs/Made"] = draw(_text(list(texts), headed=draw(st.booleans())))
    return Message("made_msgs/Made", texts)


class _Drawn:
    """Draws the values of a message."""

    def __init__(self, draw: st.DrawFn) -> None:
        self._draw = draw

    def number(self, kind: str, _name: str) -> bytes:
        return self._draw(_NUMBERS[kind])

    def text(self, _name: str) -> bytes:
        return self._draw(_TEXTS)

    def length(self, _name: str) -> int:
        return self._draw(st.integers(0, 3))


@st.composite
def messages(draw: st.DrawFn, of: Message) -> bytes:
    """Draw a serialized message of a definition."""
    return serialize(of, _Drawn(draw))
