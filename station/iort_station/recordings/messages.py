"""Samples made into ROS 1 messages, where they are not kept as messages: of fields that were selected, of
sources that are no ROS."""

from __future__ import annotations

import keyword
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from itertools import count
from typing import Any

import numpy as np
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from iort_contract.limits import Value
from iort_contract.messages.message_type import MessageType
from iort_station.cloud import Cloud
from iort_station.data import inventory
from iort_station.data.blocks import Block, values
from iort_station.errors import StationError

# What rosbags' typestore calls the kinds of a field's type: a basic one, another message, arrays.
_BASE, _NAME, _ARRAY = 1, 2, 3
_HEADER = "std_msgs/msg/Header"
_TIMES = {"builtin_interfaces/msg/Time", "builtin_interfaces/msg/Duration"}
_HEADER_TEXT = "=" * 80 + "\nMSG: std_msgs/Header\nuint32 seq\ntime stamp\nstring frame_id\n"
# ROS 2's has no seq. It may end the text.
_ROS2_HEADER = re.compile(
    r"=+\nMSG: std_msgs/Header\n\s*(time|builtin_interfaces/Time) stamp\n\s*string frame_id(\n|\Z)"
)


def types(cloud: Cloud, robot: str, stream: str) -> dict[str, tuple[int, MessageType]]:
    """The types that a robot has said a stream's messages to be, by their ids, and when it first did."""
    found: dict[str, tuple[int, MessageType]] = {}
    for t_us, kind in inventory.types_of(cloud, robot):
        if kind.stream == stream:
            first_us, before = found.get(kind.id, (t_us, kind))
            # Some publishers send no definition.
            found[kind.id] = first_us, before if before.definition.strip() else kind
    return found


def made_of(stream: str, columns: Mapping[str, Any]) -> MessageType:
    """A type for samples that no ROS message was made into: a header and a field a column."""
    lines = ["std_msgs/Header header"]
    for name, column in columns.items():
        kind = {"b": "bool", "f": "float64"}.get(column.dtype.kind, "string")
        lines.append(f"{kind} {_plain(name)}")
    name = re.sub(r"\W", "_", stream)
    kind = f"iort_msgs/{name[:1].upper()}{name[1:]}" if name[:1].isalpha() else f"iort_msgs/S{name}"
    text = "\n".join(lines) + "\n" + _HEADER_TEXT
    return MessageType(stream, f"/{name}", kind, "", text)


def _plain(path: str) -> str:
    return path.replace(".", "_")


class Maker:
    """Makes messages of one type out of samples.

    ``definition`` and ``md5sum`` are the type's as ROS 1 knows them, whose headers have a seq, also where
    the samples come from ROS 2; ``numbers`` are for the seq of those. ``lacking`` are fields of the type
    that the samples do not have, which are zero or empty in the messages; ``foreign`` are fields of the
    samples that the type does not have. ``own`` is for a type of `made_of`.

    Raises `StationError` for a type that ROS 1 cannot have.
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
        self._seq = 0
        self._field = _plain if own else str
        fields = [self._field(name) for name in fields]
        self._name = kind.kind.replace("/", "/msg/") if "/msg/" not in kind.kind else kind.kind
        self.definition = _ROS2_HEADER.sub(_HEADER_TEXT, kind.definition)
        try:
            said_md5sum = _known(kind.definition, self._name).generate_msgdef(self._name)[1]
            self._store = _known(self.definition, self._name)
            self.md5sum = self._store.generate_msgdef(self._name)[1]
            paths, self._build = self._compile(fields)
        except Exception as error:  # whatever a library raises on a text
            raise StationError(f"the type {kind.kind} cannot be made again: {error}") from error
        if kind.md5sum not in {"", said_md5sum}:
            raise StationError(f"the definition of {kind.kind} is not that of its checksum {kind.md5sum}")
        self.lacking = sorted(path for path in paths if path not in fields)
        self.foreign = sorted(set(fields) - paths)

    def messages(self, block: Block) -> Iterator[tuple[int, bytes]]:
        """Time in nanoseconds since the epoch, and the message as ROS 1 sends it, of each sample.

        A header's stamp is the sample's time, to the microsecond; its seq counts the messages from 0; its
        frame_id is empty.
        """
        columns = {self._field(name): values(column) for name, column in block.columns.items()}
        for i, t_us in enumerate(block.times_us.tolist()):
            sample = {name: column[i] for name, column in columns.items()}
            self._seq = next(self._numbers)
            message = self._build(sample, t_us)
            yield t_us * 1000, bytes(self._store.serialize_ros1(message, self._name))

    def _compile(self, fields: Sequence[str]) -> tuple[set[str], Any]:
        """The paths that the type has, and what makes a message of a sample."""
        store = self._store
        definitions = store.fielddefs
        paths: set[str] = set()

        def builder(name: str, prefix: str) -> Any:
            made = store.types[name]
            parts = {
                _attribute(field): part(kind, f"{prefix}{field}")
                for field, kind in definitions[name][1]
                if field
            }
            return lambda sample, t_us: made(**{field: of(sample, t_us) for field, of in parts.items()})

        def header(_sample: Mapping[str, Value], t_us: int) -> Any:
            stamp = store.types["builtin_interfaces/msg/Time"](
                sec=t_us // 1_000_000, nanosec=t_us % 1_000_000 * 1000
            )
            return store.types[_HEADER](seq=self._seq % 2**32, stamp=stamp, frame_id="")

        def part(kind: Any, path: str) -> Any:
            node, detail = int(kind[0]), kind[1]
            if node == _NAME:
                if detail == _HEADER:
                    return header
                return builder(detail, f"{path}.")
            if node == _BASE:
                base = detail[0]
                paths.add(path)
                return lambda sample, _t_us: _value(sample.get(path), base)
            element, length = detail
            count = length if node == _ARRAY else _elements(fields, path)
            items = [part(element, f"{path}.{i}") for i in range(count)]
            basic = element[1][0] if int(element[0]) == _BASE and element[1][0] != "string" else None

            def several(sample: Mapping[str, Value], t_us: int) -> Any:
                listed = [item(sample, t_us) for item in items]
                return listed if basic is None else np.array(listed, dtype=_DTYPES.get(basic, basic))

            return several

        lone = [(field, kind) for field, kind in definitions[self._name][1] if field != "header"]
        names = [field for field, _ in definitions[self._name][1]]
        if len(lone) == 1 and len(names) == 2 and int(lone[0][1][0]) == _NAME and lone[0][1][1] not in _TIMES:
            # A header and one thing: the sample's fields are the thing's, as the agent flattens it.
            inner = builder(lone[0][1][1], "")
            whole = store.types[self._name]
            return paths, lambda sample, t_us: whole(
                **{"header": header(sample, t_us), _attribute(lone[0][0]): inner(sample, t_us)}
            )
        return paths, builder(self._name, "")


def _attribute(field: str) -> str:
    """What rosbags calls a field, which may be a word of Python's own."""
    return f"{field}_" if keyword.iskeyword(field) else field


def _known(definition: str, name: str) -> Any:
    store = get_typestore(Stores.EMPTY)
    store.register(get_types_from_msg(definition, name))
    return store


_DTYPES = {"bool": "bool", "byte": "uint8", "char": "uint8", "octet": "uint8"}


def _elements(fields: Sequence[str], path: str) -> int:
    """How many elements of an array the samples have."""
    indexes = [name[len(path) + 1 :].partition(".")[0] for name in fields if name.startswith(f"{path}.")]
    return max((int(index) + 1 for index in indexes if index.isdecimal()), default=0)


def _value(value: Value, base: str) -> Any:
    """A value as the field's own type; null is what the wire could not carry, not a number."""
    if base == "string":
        return "" if value is None else str(value)
    if base.startswith("float"):
        return math.nan if value is None else float(value)
    if base == "bool":
        return bool(value)
    return 0 if value is None else int(value)
