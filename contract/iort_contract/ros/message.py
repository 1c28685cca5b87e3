"""A message as published, and the type that decodes it; both as batches and streams carry them."""

from __future__ import annotations

import hashlib
import struct
from typing import Any, Iterator, Mapping, NamedTuple, Sequence, ValuesView

from iort_contract.checks import COMPACT, json_object, shown
from iort_contract.codec import ROS1_CODEC, ROS2_CODEC
from iort_contract.limits import MAX_COLUMNS_BYTES, MAX_SERIALIZED_BYTES, ContractError, MessageError, Value
from iort_contract.ros.decode import Decoder, Large
from iort_contract.ros.definition import is_ros2, layout, parse
from iort_contract.ros.plan import CDR_BIG

# The size limit of a layout in a batch; ROS definitions have some thousand characters.
MAX_LAYOUT = 64 * 1024
_LENGTH, _BIG_LENGTH = struct.Struct("<I"), struct.Struct(">I")


def type_id(topic: str, kind: str, md5sum: str) -> str:
    """A type's id in batches: 8 hex digits of a hash of topic, type and MD5."""
    named = f"{topic}\0{kind}\0{md5sum}".encode("utf-8", "replace")
    return hashlib.sha256(named).hexdigest()[:8]


class RosType:
    """The type of a topic's messages: ``definition`` is the text that a publisher sends, or that a package of
    ROS 2 has.

    ``decoder`` is None if the definition is invalid, and ``error`` then says why; its messages are still
    recorded. ``layout`` is the definition as a batch carries it; of an invalid one it is empty in ROS 1, and
    the type's name alone in ROS 2.
    """

    def __init__(self, topic: str, kind: str, md5sum: str, definition: str) -> None:
        self.id = type_id(topic, kind, md5sum)
        self.topic, self.name, self.md5sum, self.definition = topic, kind, md5sum, definition
        self.ros2 = is_ros2(kind)
        self.decoder: Decoder | None = None
        self.layout = kind if self.ros2 else ""
        self.error = ""
        self._known: dict[str, bool] = {}
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

    def has(self, name: str) -> bool:
        """Whether a field can be in the messages' samples."""
        known = self._known.get(name)
        if known is None:
            known = self._known[name] = self.decoder is not None and self.decoder.has(name)
        return known


class RosMessage(Mapping[str, Value]):
    """A serialized message that reads like its flat sample; it is decoded on first use.

    ``large`` are the bytes of its ``uint8[]`` fields, to be stored elsewhere; ``beside`` are fields of the
    sample that are not in the message, such as the place of those bytes. ``arrival_us`` is when it came, by
    the receiver's clock; 0 if nobody knows. ``latched_by`` is the publisher that gives the message to later
    subscribers, too; None of one that does not.
    """

    __slots__ = ("_values", "arrival_us", "beside", "kind", "large", "latched_by", "raw")

    def __init__(
        self,
        raw: bytes,
        kind: RosType,
        *,
        large: Mapping[str, Large] | None = None,
        beside: Mapping[str, Value] | None = None,
        arrival_us: int = 0,
        latched_by: str | None = None,
    ) -> None:
        self.raw = raw
        self.kind = kind
        self.arrival_us = arrival_us
        self.latched_by = latched_by
        self.large = large or {}
        self.beside = beside or {}
        self._values: Mapping[str, Value] | None = None

    def __getitem__(self, name: str) -> Value:
        return self._sample()[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._sample())

    def __len__(self) -> int:
        return len(self._sample())

    # `Mapping` has these, too, in steps for each field: half of what a live message takes.

    def get(self, name: str, default: Any = None) -> Any:
        # Nobody decodes a message to learn that it has no fault code.
        if self._values is None and name not in self.beside and not self.kind.has(name):
            return default
        return self._sample().get(name, default)

    def values(self) -> ValuesView[Value]:
        return self._sample().values()

    def _sample(self) -> Mapping[str, Value]:
        if self._values is None:
            decoder = self.kind.decoder
            try:
                values = decoder.decode(self.raw) if decoder is not None else {}
            except MessageError:
                values = {}
            self._values = {**values, **self.beside}
        return self._values


def cut(raw: bytes, content: Large, removed: int = 0, *, ros2: bool = False) -> tuple[bytes, int]:
    """The message with an empty array in place of ``content``, and its position; `filled` undoes it.

    ``removed`` are the bytes that were cut out before, in front of it. In a message of ROS 2, up to 7 bytes
    stay, so that what follows stays aligned and can be decoded.
    """
    at = content.at - removed
    left = content[: len(content) % 8 if ros2 else 0]
    return raw[:at] + _length(raw, ros2=ros2).pack(len(left)) + left + raw[at + 4 + len(content) :], at


def filled(raw: bytes, content: bytes, at: int, *, ros2: bool = False) -> bytes:
    """Undo `cut`; raises `MessageError` if the message has no such array there."""
    length = _length(raw, ros2=ros2)
    left = content[: len(content) % 8 if ros2 else 0]
    end = at + 4 + len(left)
    if raw[at:end] != length.pack(len(left)) + left:
        raise MessageError(f"the message has no empty array at byte {at}")
    return raw[:at] + length.pack(len(content)) + content + raw[end:]


def _length(raw: bytes, *, ros2: bool) -> struct.Struct:
    return _BIG_LENGTH if ros2 and raw.startswith(CDR_BIG) else _LENGTH


class Messages(NamedTuple):
    """A batch's messages as published, all of one type: its id, its layout, and their bytes."""

    type_id: str
    layout: str
    raw: Sequence[bytes]

    @property
    def readable(self) -> bool:
        """Whether the layout has a definition."""
        return bool(self.layout) and ("\n" in self.layout or not is_ros2(self.layout))

    @property
    def codec(self) -> str:
        """The codec of a batch that keeps them unchanged."""
        return ROS2_CODEC if is_ros2(self.layout.partition("\n")[0]) else ROS1_CODEC


# Longer messages differ in more than they share.
_MAX_TURNED = 16 * 1024
_MAX_HEAD_BYTES = 1024 * 1024


def pack(messages: Messages) -> bytes:
    """The messages as bytes; raises `ContractError` if they are too large for a batch."""
    raws = messages.raw
    total = sum(map(len, raws))
    allowed = MAX_SERIALIZED_BYTES if len(raws) > 1 else MAX_COLUMNS_BYTES
    if total > allowed:
        raise ContractError(f"messages of a batch must be at most {allowed} bytes, got {total}")
    sizes = set(map(len, raws))
    data = b"".join(raws)
    turned = len(sizes) == 1 and 0 < max(sizes) <= _MAX_TURNED
    if turned:
        (size,) = sizes
        data = b"".join([data[at::size] for at in range(size)])
    head = {
        "type": messages.type_id,
        "layout": messages.layout,
        "sizes": max(sizes) if turned else list(map(len, raws)),
    }
    return COMPACT.encode(head).encode() + b"\n" + data


def unpack(body: bytes, n: int) -> Messages:
    """Decode ``n`` messages; raises `ContractError` for everything that `pack` cannot have written."""
    end = body.find(b"\n", 0, _MAX_HEAD_BYTES)
    if end < 0:
        raise ContractError("messages must have a head")
    head = json_object(body[:end], "the messages' head")
    data = body[end + 1 :]
    if n > 1 and len(data) > MAX_SERIALIZED_BYTES:
        raise ContractError(
            f"messages of a batch must be at most {MAX_SERIALIZED_BYTES} bytes, got {len(data)}"
        )
    kind, layout, sizes = head.get("type"), head.get("layout"), head.get("sizes")
    if not isinstance(kind, str) or not isinstance(layout, str):
        raise ContractError("messages must have a type and a layout")
    if type(sizes) is int:
        if not 0 < sizes <= _MAX_TURNED or len(data) != n * sizes:
            raise ContractError(f"messages must be {n} of {shown(sizes)} bytes, got {len(data)} bytes")
        turned = bytearray(len(data))
        for at in range(sizes):
            turned[at::sizes] = data[at * n : (at + 1) * n]
        data, sizes = bytes(turned), [sizes] * n
    return Messages(kind, layout, _parted(data, sizes, n))


def _parted(data: bytes, sizes: object, n: int) -> Sequence[bytes]:
    if not isinstance(sizes, list) or len(sizes) != n or not set(map(type, sizes)) <= {int} or min(sizes) < 0:
        raise ContractError(f"the messages' sizes must be {n} integers")
    if sum(sizes) != len(data):
        raise ContractError(f"messages must be {sum(sizes)} bytes by their sizes, got {len(data)}")
    parts, at = [], 0
    for size in sizes:
        parts.append(data[at : at + size])
        at += size
    return parts


# A definition is one text, cut into pieces that a field may hold.
_PIECE, _MAX_PIECES = 4000, 64
# The form that a message had before a source made ROS 1's of it.
ROS2 = "ros2"


class MessageType(NamedTuple):
    """The type of a stream's messages.

    A source sends it once a run, as a sample of the stream `TYPES_STREAM`; readers need it to rebuild the
    messages. ``kind`` has the form of its ROS: ``package/Type``, or ``package/msg/Type`` in ROS 2.
    ``definition`` is the text that a publisher sends and a bag keeps, with all nested types. ``md5sum`` is in
    ROS 2 the type's hash. ``converted_from`` is `ROS2` in old recordings of ROS 2 bags, whose messages were
    converted to ROS 1.
    """

    stream: str
    topic: str
    kind: str
    md5sum: str
    definition: str
    converted_from: str = ""

    @property
    def id(self) -> str:
        """The id in batches of this type."""
        return type_id(self.topic, self.kind, self.md5sum)

    @property
    def layout(self) -> str:
        """The layout for decoding messages, as `RosType` has it."""
        return RosType(self.topic, self.kind, self.md5sum, self.definition).layout

    def sample(self) -> dict[str, Value]:
        """The type as a sample; raises `ContractError` if the definition is too long."""
        pieces = [self.definition[i : i + _PIECE] for i in range(0, len(self.definition), _PIECE)]
        if len(pieces) > _MAX_PIECES:
            raise ContractError(
                f"definition of {self.kind} must be at most {_PIECE * _MAX_PIECES} characters"
            )
        sample: dict[str, Value] = dict(self._asdict())
        del sample["definition"]
        if not self.converted_from:
            del sample["converted_from"]
        sample.update({f"definition.{i}": piece for i, piece in enumerate(pieces)})
        return sample


def message_type(sample: Mapping[str, Value]) -> MessageType:
    """Decode a type; raises `ContractError` for everything that `MessageType.sample` cannot have written."""
    texts = {name: value for name, value in sample.items() if isinstance(value, str)}
    try:
        stream, topic, kind, md5sum = (texts[name] for name in ("stream", "topic", "kind", "md5sum"))
        pieces = [texts[f"definition.{i}"] for i in range(sum("definition." in name for name in texts))]
    except KeyError as error:
        raise ContractError(f"message type must have {error}") from error
    return MessageType(stream, topic, kind, md5sum, "".join(pieces), texts.get("converted_from", ""))
