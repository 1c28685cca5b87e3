"""Where a message has its numbers, so that many messages of one form are read at once, by arrays.

Two messages of one type and size have one form if all that decides about places is equal: the lengths of
texts and arrays. The plan and the walk are the decoder's.
"""

from __future__ import annotations

import re
import struct
from typing import Any, NamedTuple, Sequence

from iort_contract.limits import MessageError, Value
from iort_contract.ros.decode import HEADER, Decoder
from iort_contract.ros.definition import TEXTS, Definition
from iort_contract.ros.plan import CDR_LITTLE, Part, Run, padding

_FORMAT = re.compile(r"[<>](\d*)([a-zA-Z?])")


class Place(NamedTuple):
    """A number's first byte in a message, and its letter of `struct`; it is little endian."""

    at: int
    letter: str


class Form(NamedTuple):
    """The fields of a message in the order of its sample: each is a `Place`, or a text. Another message of
    the same size that has the bytes ``fixed``, pairs of begin and end, has the same texts, and its numbers in
    the same places."""

    fields: dict[str, Any]
    fixed: Sequence[tuple[int, int]]


class Places(Decoder):
    """Finds the forms of one definition's messages."""

    def __init__(self, definition: Definition) -> None:
        super().__init__(definition)
        self._fixed: list[tuple[int, int]] = []
        self._length = _Lengths(self._length, self._fixed)  # type: ignore[assignment]  # it notes what it reads

    def form(self, data: bytes) -> Form:
        """The form of a message. Raises `MessageError` for one that cannot be decoded, or is big endian."""
        if self.ros2 and data[:2] != CDR_LITTLE:
            raise MessageError(f"{self._kind}: the message is big endian")
        self._fixed.clear()
        if self.stamped and not self.ros2:
            self._fixed.append((HEADER.size - 4, HEADER.size))
        elif self.ros2:
            self._fixed.append((0, 2))
        return Form(self.decode(data), list(self._fixed))

    @staticmethod
    def _unpack(letters: str, _data: bytes, at: int) -> Sequence[Any]:
        match = _FORMAT.fullmatch(letters)
        assert match is not None, letters
        count, letter = match.groups()
        size = struct.calcsize(f"<{letter}")
        return [Place(at + i * size, letter) for i in range(int(count or 1))]

    def _read(
        self, parts: Sequence[Part], prefix: str | None, data: bytes, at: int, out: dict[str, Value]
    ) -> int:
        for part in parts:
            if not isinstance(part, Run):
                at = super()._read([part], prefix, data, at, out)
                continue
            if at + part.sizes[at & self._mask] > len(data):
                raise struct.error
            if prefix is not None and len(out) <= self._limit:
                for path, within, letter in part.places(prefix, at & self._mask):
                    out[path] = Place(at + within, letter)  # type: ignore[assignment]  # where the value is
            at += part.sizes[at & self._mask]
        return at

    def _value(self, kind: str, path: str | None, data: bytes, at: int, out: dict[str, Value]) -> int:
        end = super()._value(kind, path, data, at, out)
        if kind in TEXTS and path is not None:
            self._fixed.append((at + (padding(at, 4) if self.ros2 else 0), end))
        return end


class _Lengths:
    """Reads lengths, and notes where."""

    def __init__(self, length: struct.Struct, fixed: list[tuple[int, int]]) -> None:
        self._length, self._fixed = length, fixed

    def unpack_from(self, data: bytes, at: int) -> tuple[Any, ...]:
        self._fixed.append((at, at + self._length.size))
        return self._length.unpack_from(data, at)
