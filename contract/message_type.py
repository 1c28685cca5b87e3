"""The ROS types that a stream's samples were made of, and whose frame they are in, told as a stream."""

from __future__ import annotations

from typing import Mapping, NamedTuple

from contract.limits import ContractError, Value

# A definition is a text of its own, in pieces that a field may hold.
_PIECE, _MAX_PIECES = 4000, 64
_FRAME_ID, _FRAME_SINCE = "frame_id", "frame_since_us"


class MessageType(NamedTuple):
    """The ROS 1 type of the messages that a stream's samples are made of.

    A source says it once a run, as a sample of the stream `TYPES_STREAM`: from then on downstream knows
    how to make the messages again. ``kind`` is as ROS 1 writes it, ``package/Type``; ``definition`` is the
    text that a publisher sends and a bag keeps, with every type within.
    """

    stream: str
    topic: str
    kind: str
    md5sum: str
    definition: str

    def sample(self) -> dict[str, Value]:
        """The type as a sample. Raises `ContractError` for a definition that is too long."""
        pieces = [self.definition[i : i + _PIECE] for i in range(0, len(self.definition), _PIECE)]
        if len(pieces) > _MAX_PIECES:
            raise ContractError(f"the definition of {self.kind} has over {_PIECE * _MAX_PIECES} characters")
        sample: dict[str, Value] = dict(self._asdict())
        del sample["definition"]
        sample.update({f"definition.{i}": piece for i, piece in enumerate(pieces)})
        return sample


def message_type(sample: Mapping[str, Value]) -> MessageType:
    """The type in a sample; raises `ContractError` for what `MessageType.sample` cannot have written."""
    texts = {name: value for name, value in sample.items() if isinstance(value, str)}
    try:
        stream, topic, kind, md5sum = (texts[name] for name in ("stream", "topic", "kind", "md5sum"))
        pieces = [texts[f"definition.{i}"] for i in range(sum("definition." in name for name in texts))]
    except KeyError as error:
        raise ContractError(f"a message type without {error}") from error
    return MessageType(stream, topic, kind, md5sum, "".join(pieces))


class FrameId(NamedTuple):
    """The ``frame_id`` of the headers of a topic's messages, from the sample at ``since_us`` (microseconds
    since the epoch) on, until another is said.

    A sample of the stream `TYPES_STREAM`, beside the type's. It names its time itself, because two samples
    of a stream never have the same, and the later one is moved.
    """

    stream: str
    topic: str
    frame_id: str
    since_us: int

    def sample(self) -> dict[str, Value]:
        """The frame as a sample."""
        return {
            "stream": self.stream,
            "topic": self.topic,
            _FRAME_ID: self.frame_id,
            _FRAME_SINCE: self.since_us,
        }


def frame_id(sample: Mapping[str, Value]) -> FrameId:
    """The frame in a sample; raises `ContractError` for what `FrameId.sample` cannot have written."""
    texts = [sample.get(name) for name in ("stream", "topic", _FRAME_ID)]
    since = sample.get(_FRAME_SINCE)
    if not all(isinstance(value, str) for value in texts):
        raise ContractError(f"a frame without a text in each of stream, topic and {_FRAME_ID}")
    # A reader of whole columns has made a float of it.
    if isinstance(since, bool) or not isinstance(since, (int, float)) or not float(since).is_integer():
        raise ContractError(f"a frame whose {_FRAME_SINCE} is {since!r}, not a number of microseconds")
    stream, topic, name = map(str, texts)
    return FrameId(stream, topic, name, int(since))
