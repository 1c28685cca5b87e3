"""Makes ROS 1 messages of samples that are not kept as messages: of selected fields, and of sources without
ROS."""

from __future__ import annotations

import math
import re
import struct
from collections.abc import Iterator, Mapping, Sequence
from itertools import count
from typing import Any, NamedTuple

from iort_analysis.samples.blocks import Block, values
from iort_contract.limits import MessageError, Value
from iort_contract.ros.decode import HEADER
from iort_contract.ros.definition import (
    HEADER_TYPE,
    LETTERS,
    RULE,
    STRING,
    VARIABLE,
    WSTRING,
    Definition,
    Field,
    is_ros2,
    md5sum,
    parse,
)
from iort_contract.ros.message import ROS2, MessageType
from iort_station.cloud import Cloud
from iort_station.data import inventory
from iort_station.data.ros_forms import form_of
from iort_station.errors import StationError

_WSTRING = re.compile(rf"\b{WSTRING}\b")
_HEADER_TEXT = f"{RULE}\nMSG: std_msgs/Header\nuint32 seq\ntime stamp\nstring frame_id\n"


def types(cloud: Cloud, robot: str) -> dict[str, MessageType]:
    """The types that a robot has declared for its messages, by id, in the order of their first
    declarations."""
    declared_types: dict[str, MessageType] = {}
    for _, kind in inventory.types_of(cloud, robot):
        before = declared_types.get(kind.id, kind)
        # Some publishers send no definition.
        declared_types[kind.id] = before if before.definition.strip() else kind
    return declared_types


def in_ros1(kind: MessageType) -> MessageType:
    """A type of ROS 2 as one of ROS 1 that becomes ROS 2's again in a file that can hold it."""
    if not is_ros2(kind.kind):
        return kind
    # ROS 1 has one kind of text.
    form = form_of(kind._replace(definition=_WSTRING.sub(STRING, kind.definition)), ros2=False, own=True)
    return kind._replace(kind=form.kind, definition=form.definition, md5sum=form.md5sum, converted_from=ROS2)


def made_of(stream: str, columns: Mapping[str, Any], number: int = 0) -> MessageType:
    """A type for samples without one: a header, and a field for each column. A stream's second type has
    ``number`` 1, and another name and topic, as the rest of its types."""
    lines = ["std_msgs/Header header"]
    for name, column in columns.items():
        kind = {"b": "bool", "f": "float64"}.get(column.dtype.kind, STRING)
        lines.append(f"{kind} {_plain(name)}")
    name = re.sub(r"\W", "_", stream) + (f"_{number + 1}" if number else "")
    kind = f"iort_msgs/{name[:1].upper()}{name[1:]}" if name[:1].isalpha() else f"iort_msgs/S{name}"
    text = "\n".join(lines) + "\n" + _HEADER_TEXT
    return MessageType(stream, f"/{name}", kind, "", text)


def _plain(path: str) -> str:
    return path.replace(".", "_")


class _Leaf(NamedTuple):
    """A number, a text or a header in the wire's order; or the length of an array, whose kind is empty."""

    kind: str
    path: str
    length: int = 0


class Maker:
    """Makes messages of a type of ROS 1 from samples.

    ``numbers`` gives the headers' seq. ``lacking`` are fields of the type that the samples do not have: they
    are zero or empty in the messages. ``foreign`` are fields of the samples that the type does not have.
    ``own`` is for a type of `made_of`.

    Raises `StationError` for an invalid definition.
    """

    def __init__(
        self,
        kind: MessageType,
        fields: Sequence[str],
        *,
        own: bool = False,
        numbers: Iterator[int] | None = None,
    ) -> None:
        self.kind = kind
        self._numbers = count() if numbers is None else numbers
        self._field = _plain if own else str
        fields = [self._field(name) for name in fields]
        try:
            definition = parse(kind.kind, kind.definition)
            digest = md5sum(definition, kind.definition)
            self._leaves = list(_message(definition, fields))
        except (MessageError, KeyError, ValueError) as error:
            raise StationError(f"the type {kind.kind} cannot be made again: {error}") from error
        if kind.md5sum not in {"", digest}:
            raise StationError(f"{kind.kind}: the MD5 of its definition must be {kind.md5sum}, got {digest}")
        paths = {leaf.path for leaf in self._leaves if leaf.path}
        self.lacking = sorted(paths - set(fields))
        self.foreign = sorted(set(fields) - paths)

    def messages(self, block: Block) -> Iterator[tuple[int, bytes]]:
        """Each sample's time in nanoseconds since the epoch, and its message as ROS 1 sends it.

        A header's stamp is the sample's time, to the microsecond; its seq counts the messages from 0; its
        frame_id is empty.
        """
        columns = {self._field(name): values(column) for name, column in block.columns.items()}
        for i, t_us in enumerate(block.times_us.tolist()):
            sample = {name: column[i] for name, column in columns.items()}
            header = HEADER.pack(next(self._numbers) % 2**32, t_us // 1_000_000, t_us % 1_000_000 * 1000, 0)
            yield t_us * 1000, b"".join(_written(leaf, sample, header) for leaf in self._leaves)


def _message(definition: Definition, fields: Sequence[str]) -> Iterator[_Leaf]:
    own = definition.fields()
    if definition.stamped() and len(own) == 2 and own[1].length is None and own[1].kind in definition.types:
        # A header and one message: the sample's fields are that message's, as the decoder flattens it.
        yield _Leaf(HEADER_TYPE, "")
        own = definition.fields(own[1].kind)
    for field in own:
        yield from _field(definition, field, field.name, fields)


def _field(definition: Definition, field: Field, path: str, fields: Sequence[str]) -> Iterator[_Leaf]:
    if field.length is not None:
        length = _elements(fields, path) if field.length == VARIABLE else field.length
        if field.length == VARIABLE:
            yield _Leaf("", "", length)
        for i in range(length):
            yield from _field(definition, Field(field.name, field.kind, None), f"{path}.{i}", fields)
    elif field.kind == HEADER_TYPE:
        yield _Leaf(HEADER_TYPE, "")
    elif field.kind in definition.types:
        for nested in definition.fields(field.kind):
            yield from _field(definition, nested, f"{path}.{nested.name}", fields)
    else:
        yield _Leaf(field.kind, path)


def _elements(fields: Sequence[str], path: str) -> int:
    """The number of an array's elements in the samples."""
    indexes = [name[len(path) + 1 :].partition(".")[0] for name in fields if name.startswith(f"{path}.")]
    return max((int(index) + 1 for index in indexes if index.isdecimal()), default=0)


def _written(leaf: _Leaf, sample: Mapping[str, Value], header: bytes) -> bytes:
    """A value as the field's own type. A null in a float is NaN, which JSON cannot carry."""
    if leaf.kind == HEADER_TYPE:
        return header
    if not leaf.kind:
        return struct.pack("<I", leaf.length)
    value = sample.get(leaf.path)
    if leaf.kind == STRING:
        text = ("" if value is None else str(value)).encode()
        return struct.pack("<I", len(text)) + text
    letter = LETTERS[leaf.kind]
    if letter == "?":
        return struct.pack("<?", value)
    if letter not in "fd":
        return struct.pack(f"<{letter}", 0 if value is None else int(value))
    number = math.nan if value is None else float(value)
    try:
        return struct.pack(f"<{letter}", number)
    except OverflowError:
        return struct.pack(f"<{letter}", math.copysign(math.inf, number))
