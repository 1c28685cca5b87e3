"""The ROS types that a stream's samples were made of, told as a stream."""

from __future__ import annotations

from typing import Mapping, NamedTuple

from iort_contract.limits import ContractError, Value
from iort_contract.ros1.message import RosType, type_id

# A definition is a text of its own, in pieces that a field may hold.
_PIECE, _MAX_PIECES = 4000, 64


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

    @property
    def id(self) -> str:
        """By which batches refer to it."""
        return type_id(self.topic, self.kind, self.md5sum)

    @property
    def layout(self) -> str:
        """What it takes to decode the messages; empty where the definition is none."""
        return RosType(self.topic, self.kind, self.md5sum, self.definition).layout

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
