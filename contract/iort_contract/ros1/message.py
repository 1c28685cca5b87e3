"""A message as it was published, and the type that says how to read it."""

from __future__ import annotations

import hashlib
import struct
from typing import Iterator, Mapping, NamedTuple, Sequence

from iort_contract.limits import MessageError, Value
from iort_contract.ros1.decode import Decoder
from iort_contract.ros1.definition import layout, parse

# Of a layout in a batch; the definitions of ROS have some thousand characters.
MAX_LAYOUT = 64 * 1024
_LENGTH = struct.Struct("<I")


def type_id(topic: str, kind: str, md5sum: str) -> str:
    """The name by which a batch refers to a topic's type: 8 hex digits of a hash of the three."""
    named = f"{topic}\0{kind}\0{md5sum}".encode("utf-8", "replace")
    return hashlib.sha256(named).hexdigest()[:8]


class RosType:
    """The type of a topic's messages: ``definition`` is the text that a publisher sends.

    ``decoder`` is None where the definition cannot be read, and ``error`` then says why; its messages are
    recorded all the same. ``layout`` is the definition as a batch carries it, empty where there is none.
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
                self.error = f"{kind}: its layout has over {MAX_LAYOUT} characters"
        except MessageError as error:
            self.error = str(error)


class RosMessage(Mapping[str, Value]):
    """A serialized message, which reads as the flat sample that it makes; looked into when asked.

    ``large`` are the bytes of its ``uint8[]`` fields, for whoever keeps them elsewhere; ``beside`` are fields
    of the sample that are not in the message, such as where they are kept.
    """

    __slots__ = ("_values", "beside", "kind", "large", "raw")

    def __init__(
        self,
        raw: bytes,
        kind: RosType,
        *,
        large: Mapping[str, bytes] | None = None,
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
                values = decoder.decode(self.raw)[0] if decoder is not None else {}
            except MessageError:
                values = {}
            self._values = {**values, **self.beside}
        return self._values


def cut(raw: bytes, content: bytes) -> tuple[bytes, int]:
    """The message with an empty array in the place of this one, and where that is; `filled` undoes it."""
    at = raw.index(_LENGTH.pack(len(content)) + content)
    return raw[:at] + _LENGTH.pack(0) + raw[at + 4 + len(content) :], at


def filled(raw: bytes, content: bytes, at: int) -> bytes:
    """The message that `cut` was given. Raises `MessageError` where no empty array is there."""
    if raw[at : at + 4] != _LENGTH.pack(0):
        raise MessageError(f"no empty array at byte {at} of the message")
    return raw[:at] + _LENGTH.pack(len(content)) + content + raw[at + 4 :]


class Messages(NamedTuple):
    """A batch's messages as they were published, all of one type: its id, its layout, and their bytes."""

    type_id: str
    layout: str
    raw: Sequence[bytes]
