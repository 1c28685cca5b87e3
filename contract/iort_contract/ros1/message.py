"""A message as published, and its type, which is needed to decode it."""

from __future__ import annotations

import hashlib
import struct
from typing import Iterator, Mapping, NamedTuple, Sequence

from iort_contract.limits import MessageError, Value
from iort_contract.ros1.decode import Decoder, Large
from iort_contract.ros1.definition import layout, parse

# The size limit of a layout in a batch; ROS definitions have some thousand characters.
MAX_LAYOUT = 64 * 1024
_LENGTH = struct.Struct("<I")


def type_id(topic: str, kind: str, md5sum: str) -> str:
    """A type's id in batches: 8 hex digits of a hash of topic, type and MD5."""
    named = f"{topic}\0{kind}\0{md5sum}".encode("utf-8", "replace")
    return hashlib.sha256(named).hexdigest()[:8]


class RosType:
    """The type of a topic's messages: ``definition`` is the text that a publisher sends.

    ``decoder`` is None if the definition is invalid, and ``error`` then says why; its messages are still
    recorded. ``layout`` is the definition as a batch carries it, or empty.
    """

    def __init__(self, topic: str, kind: str, md5sum: str, definition: str) -> None:
        self.id = type_id(topic, kind, md5sum)
        self.decoder: Decoder | None = None
        self.layout = self.error = ""
        try:
            parsed = parse(kind, definition)
            written = f"{kind}\n{layout(parsed)}"
            if len(written) <= MAX_LAYOUT:
                self.decoder = Decoder(parsed)
                self.layout = written
            else:
                self.error = f"{kind}: layout must be at most {MAX_LAYOUT} characters"
        except MessageError as error:
            self.error = str(error)


class RosMessage(Mapping[str, Value]):
    """A serialized message that reads like its flat sample; it is decoded on first use.

    ``large`` are the bytes of its ``uint8[]`` fields, to be stored elsewhere; ``beside`` are fields of the
    sample that are not in the message, such as the place of those bytes.
    """

    __slots__ = ("_values", "beside", "kind", "large", "raw")

    def __init__(
        self,
        raw: bytes,
        kind: RosType,
        *,
        large: Mapping[str, Large] | None = None,
        beside: Mapping[str, Value] | None = None,
    ) -> None:
        self.raw = raw
        self.kind = kind
        self.large = large or {}
        self.beside = beside or {}
        self._values: Mapping[str, Value] | None = None

    def __getitem__(self, name: str) -> Value:
        return self._sample()[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._sample())

    def __len__(self) -> int:
        return len(self._sample())

    def _sample(self) -> Mapping[str, Value]:
        if self._values is None:
            decoder = self.kind.decoder
            try:
                values = decoder.decode(self.raw) if decoder is not None else {}
            except MessageError:
                values = {}
            self._values = {**values, **self.beside}
        return self._values


def cut(raw: bytes, content: Large, removed: int = 0) -> tuple[bytes, int]:
    """The message with an empty array in place of ``content``, and its position; `filled` undoes it.

    ``removed`` are the bytes that were cut out before, in front of it.
    """
    at = content.at - removed
    return raw[:at] + _LENGTH.pack(0) + raw[at + 4 + len(content) :], at


def filled(raw: bytes, content: bytes, at: int) -> bytes:
    """Undo `cut`; raises `MessageError` if the message has no empty array there."""
    if raw[at : at + 4] != _LENGTH.pack(0):
        raise MessageError(f"the message has no empty array at byte {at}")
    return raw[:at] + _LENGTH.pack(len(content)) + content + raw[at + 4 :]


class Messages(NamedTuple):
    """A batch's messages as published, all of one type: its id, its layout, and their bytes."""

    type_id: str
    layout: str
    raw: Sequence[bytes]
