"""The ROS types of a stream's messages, sent as a stream."""

from __future__ import annotations

from typing import Mapping, NamedTuple

from iort_contract.limits import ContractError, Value
from iort_contract.ros1.message import RosType, type_id

# A definition is one text, cut into pieces that a field may hold.
_PIECE, _MAX_PIECES = 4000, 64
# The form that a message had before a source made ROS 1's of it.
ROS2 = "ros2"


class MessageType(NamedTuple):
    """The ROS 1 type of a stream's messages.

    A source sends it once a run, as a sample of the stream `TYPES_STREAM`; readers need it to rebuild the
    messages. ``kind`` is in ROS 1's form, ``package/Type``; ``definition`` is the text that a publisher sends
    and a bag keeps, with all nested types. ``converted_from`` is `ROS2` for messages of ROS 2 that the source
    has converted to this type, and empty for those that are as they were published.
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
        """The layout for decoding messages; empty for an invalid definition."""
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
