"""Decodes a message of ROS 1 or ROS 2 to a flat sample, by its definition: field path -> value.

This is the only rule of flattening, and both have the same paths. Nested messages give dotted paths and
arrays give indexes: ``pose.position.x``, ``covariance.0``. Time and duration become ``sec`` and ``nanosec``,
as in ROS 2. A leading header is left out, because its stamp is the sample's time. A message of a header and
exactly one nested message (VescStateStamped, PoseStamped) gives that message's fields without a prefix.

The sample is a view; the record holds the message. The view leaves out and counts the fields that no table
shows: arrays of more than `MAX_ELEMENTS`, ``uint8[]`` of any length, texts of more than `MAX_TEXT`
characters, fields beyond `MAX_FIELDS`.
"""

from __future__ import annotations

import re
import struct
from functools import lru_cache
from itertools import islice
from typing import Any, Callable, Dict, Sequence

from iort_contract.limits import MAX_FIELDS, MessageError, Value
from iort_contract.ros.definition import (
    LETTERS,
    TEXTS,
    VARIABLE,
    WSTRING,
    Definition,
    Field,
    Fields,
    short_kind,
)
from iort_contract.ros.plan import (
    CDR_BIG,
    CDR_LITTLE,
    CDR_START,
    MAX_ELEMENTS,
    SIZES,
    Part,
    Run,
    Types,
    cdr_order,
    cdr_text,
    fits,
    is_loose,
    padding,
)

MAX_TEXT = 4096
# A message with more elements of variable size in one array is not decoded.
_MAX_WALKED = 20_000
# A message of a fixed size has at most this many bytes.
_MAX_FIXED_BYTES = 2**31
# With a selection, this many fields are decoded before the rest of the message is skipped.
_MAX_SEARCHED = 20_000
_MAX_CACHED = 1000

# A header begins with seq, the stamp's seconds and nanoseconds, and the length of the frame_id.
HEADER = struct.Struct("<IIII")
# In ROS 2 it has no seq, and the bytes that tell the byte order are before it.
CDR_HEADER = struct.Struct("<4xiII")
_CDR_STAMPS = {CDR_LITTLE: struct.Struct("<4xiI"), CDR_BIG: struct.Struct(">4xiI")}
_LENGTH = struct.Struct("<I")
_BLOBS = ("uint8", "char")
_BEYOND = f"(fields beyond {MAX_FIELDS})"


def stamp_ns(data: bytes, *, ros2: bool = False) -> int | None:
    """The header stamp of a stamped message; None if the message is too short to have one."""
    if ros2:
        stamp = _CDR_STAMPS.get(data[:2])
        if stamp is None or len(data) < CDR_HEADER.size:
            return None
        sec, nanosec = stamp.unpack_from(data)
    elif len(data) < HEADER.size:
        return None
    else:
        _, sec, nanosec, _ = HEADER.unpack_from(data)
    return int(sec) * 1_000_000_000 + int(nanosec)


class Decoder:
    """Decodes the messages of one definition.

    ``select`` names the wanted paths, or their beginnings; None selects all. An element that is named
    (``ranges.540``) is taken from an array of any length. With ``large``, a ``uint8[]`` stays `Large` bytes.

    ``stamped`` is true if messages begin with a header. ``unknown`` are selected paths that the message does
    not have. ``left_out`` counts the omitted values by path. ``walked`` counts the elements of variable size
    that were read one by one, times their fields: the main cost of decoding. ``flat`` are the numbers of a
    message that has only numbers after its header; None for other messages. ``order`` is the byte order that
    `struct` knows as ``<`` or ``>``; a message of ROS 2 may be of either.
    """

    def __init__(
        self,
        definition: Definition,
        *,
        select: Sequence[str] | None = None,
        large: bool = False,
        order: str = "<",
    ) -> None:
        self.stamped = definition.stamped()
        self.ros2 = definition.ros2
        self.left_out: dict[str, int] = {}
        self.walked = 0
        self._kind = definition.kind
        self._types = definition.types
        self._select = select
        self._large = large
        self._limit = MAX_FIELDS if select is None else _MAX_SEARCHED
        self._definition = definition
        self._order = order
        self._mask = 7 if self.ros2 else 0
        self._length = struct.Struct(f"{order}I")
        self._big_endian: Decoder | None = None
        self._compiled = Types(definition.types, self.wanted, aligned=self.ros2, order=order)
        # Only ever grows, so that a thread does not miss what another one counts.
        self._loose = 0
        self._chosen: dict[str, bool] = {}
        name = short_kind(self._kind)
        fields = definition.fields()
        body = fields[1:] if self.stamped else fields
        extent = self._compiled.extent(name)
        if extent is not None and extent.sizes[0] > _MAX_FIXED_BYTES:
            raise MessageError(f"{self._kind}: the message would be too large: {extent.sizes[0]} bytes")
        if self.stamped and len(body) == 1 and body[0].length is None and body[0].kind in self._types:
            name, body = body[0].kind, self._types[body[0].kind]
            self._body = self._compiled.parts(name)
        else:
            self._body = self._compiled.compile(body) if self.stamped else self._compiled.parts(name)
        self._fields = body
        self.unknown = sorted(path for path in select or () if not self.has(path))
        self.flat: Run | None = None
        if len(self._body) == 1 and isinstance(self._body[0], Run) and self._body[0].numbers <= MAX_FIELDS:
            self.flat = self._body[0] if self._body[0].named("")[1] else None

    # What reads the numbers that stand alone, and those of arrays.
    _unpack: Callable[..., Sequence[Any]] = staticmethod(struct.unpack_from)

    def decode(self, data: bytes) -> dict[str, Value]:
        """The message as a sample; raises `MessageError` if the bytes do not fit the definition."""
        at = 0
        if self.ros2:
            at = CDR_START
            if data[:2] != CDR_LITTLE and self._order == "<":
                return self._decode_big_endian(data)
        values: dict[str, Value] = {}
        loose = self._loose
        try:
            if self.stamped:
                # The method costs more than what it does.
                at = self.body(data) if self.ros2 else HEADER.size + HEADER.unpack_from(data)[3]
            at = self._read(self._body, "", data, at, values)
        except struct.error as error:
            raise MessageError(f"{self._kind}: the message of {len(data)} bytes is truncated") from error
        if at != len(data) and not fits(at, len(data), ros2=self.ros2, loose=self._loose - loose):
            raise MessageError(f"{self._kind}: the message must have {at} bytes, got {len(data)}")
        if self._select is not None:
            values = {path: value for path, value in values.items() if self.wanted(path)}
        if len(values) > MAX_FIELDS:
            self._leave_out(_BEYOND)
            values = dict(islice(values.items(), MAX_FIELDS))
        return values

    def _decode_big_endian(self, data: bytes) -> dict[str, Value]:
        order = cdr_order(self._kind, data)
        if self._big_endian is None:
            self._big_endian = Decoder(self._definition, select=self._select, large=self._large, order=order)
            self._big_endian.left_out = self.left_out
        walked = self._big_endian.walked
        try:
            return self._big_endian.decode(data)
        finally:
            self.walked += self._big_endian.walked - walked

    def body(self, data: bytes) -> int:
        """The place behind the header of a stamped message; raises `struct.error` if it is too short."""
        if self.ros2:
            at = CDR_HEADER.size
            return at + int(self._length.unpack_from(data, at - _LENGTH.size)[0])
        return HEADER.size + int(HEADER.unpack_from(data)[3])

    # Reading. A path of None skips the value.

    def _read(self, parts: Sequence[Part], prefix: str | None, data: bytes, at: int, out: _Sample) -> int:
        for part in parts:
            # The next values would be cut from a full sample.
            shown = prefix is not None and len(out) <= self._limit
            if isinstance(part, Run):
                phase = at & self._mask
                if shown:
                    # Here, too.
                    reader, names = part.compiled[phase].get(prefix or "") or part.named(prefix or "", phase)
                    out.update(zip(names, reader.unpack_from(data, at)))
                at += part.sizes[phase]
                continue
            path = f"{prefix}{part.name}" if shown else None
            if part.length is None:
                at = self._value(part.kind, path, data, at, out)
            else:
                at = self._array(part, path, data, at, out)
        return at

    def _value(self, kind: str, path: str | None, data: bytes, at: int, out: _Sample) -> int:
        if kind in self._types:
            return self._read(self._compiled.parts(kind), None if path is None else f"{path}.", data, at, out)
        if kind in TEXTS:
            if self.ros2:
                at += padding(at, 4)
            (n,) = self._length.unpack_from(data, at)
            at += 4
            end = at + n
            if kind == WSTRING:
                end += 3 * n
                self._loose += 1
            if path is not None:
                text = None
                if end - at <= 4 * MAX_TEXT:
                    # Neither ROS defines the encoding of a text.
                    content = data[at:end]
                    text = (
                        cdr_text(kind, content, self._order)
                        if self.ros2
                        else content.decode("utf-8", "replace")
                    )
                if text is None or len(text) > MAX_TEXT:
                    self._leave_out(path)
                else:
                    out[path] = text
            return int(end)
        if self.ros2:
            at += padding(at, SIZES[kind])
        assert path is not None
        (out[path],) = self._unpack(f"{self._order}{LETTERS[kind]}", data, at)
        return at

    def _array(self, field: Field, path: str | None, data: bytes, at: int, out: _Sample) -> int:
        kind, n = field.kind, field.length or 0
        blob = n == VARIABLE and kind in _BLOBS
        if n == VARIABLE:
            if self.ros2:
                at += padding(at, 4)
            (n,) = self._length.unpack_from(data, at)
            at += 4
        extent = self._compiled.extent(kind)
        size = 0
        if kind in LETTERS:
            if self.ros2 and n:
                at += padding(at, SIZES[kind])
            elif self.ros2:
                self._loose += is_loose(kind, n)
            size = n * SIZES[kind]
        elif extent is not None:
            size = extent.times(n, at & self._mask)
        if at + size > len(data):
            raise struct.error
        shown: Sequence[int] = ()
        if path is not None and blob and self._large:
            out[path] = Large(data[at : at + n], at - _LENGTH.size)  # type: ignore[assignment]  # for the attachments
        elif path is not None and n <= MAX_ELEMENTS and not blob:
            shown = range(n)
        elif path is not None:
            shown = [i for i in _indexes(tuple(self._select or ()), _label(path)) if i < n]
            self._leave_out(path)
        # Empty arrays are no fields, so nothing limits their number: they must not cost names.
        if n and kind in LETTERS and isinstance(shown, range):
            letters = f"{self._order}{n}{LETTERS[kind]}"
            out.update(zip(_element_names(path or ""), self._unpack(letters, data, at)))
        elif extent is not None:
            for i in shown if extent.numbers else ():
                if len(out) <= self._limit:
                    self._value(kind, f"{path}.{i}", data, at + extent.times(i, at & self._mask), out)
        if extent is not None:
            return at + size
        if n > _MAX_WALKED:
            raise MessageError(f"{path or kind}: too many elements to decode: {n}")
        self.walked += n * (len(self._compiled.parts(kind)) if kind in self._types else 1)
        for i in range(n):
            here = f"{path}.{i}" if i in shown and len(out) <= self._limit else None
            at = self._value(kind, here, data, at, out)
        return at

    def _leave_out(self, path: str) -> None:
        label = _label(path)
        if label == _BEYOND or self.wanted(label):
            self.left_out[label] = self.left_out.get(label, 0) + 1

    # The selection.

    def wanted(self, path: str) -> bool:
        """Whether a path is selected."""
        if self._select is None:
            return True
        if path not in self._chosen:
            if len(self._chosen) >= _MAX_SEARCHED:
                self._chosen.clear()
            self._chosen[path] = any(path == name or path.startswith(f"{name}.") for name in self._select)
        return self._chosen[path]

    def has(self, path: str) -> bool:
        """Whether a path can be in the messages."""
        return self._has(path.split("."), self._fields)

    def _has(self, parts: Sequence[str], fields: Fields) -> bool:
        field = next((field for field in fields if field.name == parts[0]), None)
        rest = parts[1:]
        if field is None or not rest:
            return field is not None
        if field.length is not None:
            if not rest[0].isdecimal() or 0 <= field.length <= int(rest[0]):
                return False
            rest = rest[1:]
        return not rest or self._has(rest, self._types.get(field.kind, ()))


class Large(bytes):
    """The bytes of an array, with the place of their length in the message: ``at``."""

    at: int

    def __new__(cls, content: bytes, at: int) -> Large:  # noqa: PYI034 - Python 3.8 has no Self
        large = super().__new__(cls, content)
        large.at = at
        return large


_Sample = Dict[str, Value]


@lru_cache(maxsize=_MAX_CACHED)
def _label(path: str) -> str:
    """The path without the indexes of elements."""
    return re.sub(r"\.\d+", "", path, flags=re.ASCII)


@lru_cache(maxsize=_MAX_CACHED)
def _element_names(path: str) -> list[str]:
    return [f"{path}.{i}" for i in range(MAX_ELEMENTS)]


@lru_cache(maxsize=_MAX_CACHED)
def _indexes(select: tuple[str, ...], label: str) -> list[int]:
    """The elements of an array that are selected by number."""
    pattern = re.compile(r"(?:\.\d+)*\.".join(label.split(".")) + r"\.(\d+)(?![^.])", re.ASCII)
    return sorted({int(match.group(1)) for match in map(pattern.match, select) if match})
