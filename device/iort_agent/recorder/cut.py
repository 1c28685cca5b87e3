"""Cuts an incident from the ring into one indexed MCAP: the messages byte for byte, with their definitions.

A message belongs to the window if it came in it, or by its own time is of it. The file has another name until
it is complete and on the disk. Its metadata say why it was kept, and what is missing:

- ``iort.incident``: the incident, its triggers and edges with their values, the agent and its state
- ``iort.account``: by topic, the messages in the window, the missing ones, and why; and how many ``latched``
  ones are before them

The latched messages that are in force at the window's begin come first. Their log time is the begin, so
that a player gives them at once and the file is not longer than the window; their publish time is their own.
Topics that latch say so to `ros2 bag play`, whose subscribers would not hear them otherwise.
"""

from __future__ import annotations

import hashlib
import importlib
import json
import os
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Any, BinaryIO, Callable, Container, Iterator, Mapping, NamedTuple, Protocol, Sequence

from iort_agent.recorder.account import Account, Losses
from iort_agent.recorder.config import NONE, ZSTD
from iort_agent.recorder.latched import Latched
from iort_agent.recorder.ledger import fits
from iort_agent.recorder.plan import Incident
from iort_agent.recorder.ring import Drop, RingChannel, RingMessage
from iort_contract.messages.recorder import ABOUT_RECORD, ACCOUNT_RECORD

PART = ".part"
# A message's own time may be so much off the time at which it came, and it is looked for.
SLACK_US = 1_000_000
# Between two pauses: the sources' threads must not wait for this one.
_BURST, _ROOM_EVERY = 64, 1024
_PROFILES = {"ros1": "ros1", "cdr": "ros2"}
_LIBRARY = "iort-agent"
# What a player of ROS 2 offers for a topic that latches, in the form that every rosbag2 since Foxy reads.
_QOS = "offered_qos_profiles"
_NEVER = "{sec: 2147483647, nsec: 4294967295}"
_LATCHES = (
    "- {history: 1, depth: 16, reliability: 1, durability: 1, "
    f"deadline: {_NEVER}, lifespan: {_NEVER}, liveliness: 1, liveliness_lease_duration: {_NEVER}, "
    "avoid_ros_namespace_conventions: false}\n"
)


class TooLargeError(Exception):
    """The file would be larger than it may be."""


class Source(Protocol):
    """What is read of a ring; see `iort_agent.recorder.ring.Ring`."""

    def read(self, from_us: int, to_us: int, wanted: Sequence[str] | None) -> Iterator[RingMessage]: ...
    def drops(self, from_us: int, to_us: int) -> Sequence[Drop]: ...
    def latched(self, at_us: int, wanted: Sequence[str] | None) -> Latched: ...
    def since_us(self) -> int: ...


class Cut(NamedTuple):
    """A file that was cut: its size and SHA-256, what is in it and how much is missing; ``late_us`` is how
    long after the window's begin the ring begins."""

    size: int
    sha256: str
    messages: int
    missing: int
    late_us: int


class _Hashed:
    """A file that is hashed while it is written, and that does not become larger than ``limit``."""

    def __init__(self, file: BinaryIO, limit: int | None) -> None:
        self._file, self._limit = file, limit
        self.size, self.sha256 = 0, hashlib.sha256()

    def write(self, data: bytes) -> int:
        self.size += len(data)
        if self._limit is not None and self.size > self._limit:
            raise TooLargeError
        self.sha256.update(data)
        return self._file.write(data)

    def tell(self) -> int:
        return self.size

    def flush(self) -> None:
        self._file.flush()


class _Channels:
    """Registers each channel of the ring once; runs of the agent share one if nothing has changed."""

    def __init__(self, writer: Any, latching: Container[str]) -> None:
        self._writer, self._latching = writer, latching
        self._schemas: dict[tuple[str, str, bytes], int] = {}
        self._ids: dict[tuple[object, ...], int] = {}
        self._known: dict[int, tuple[RingChannel, int]] = {}

    def id_of(self, channel: RingChannel) -> int:
        known = self._known.get(id(channel))
        if known is not None and known[0] is channel:
            return known[1]
        schema = (channel.schema, channel.schema_encoding, channel.definition)
        if schema not in self._schemas:
            named = bool(channel.schema or channel.definition)
            self._schemas[schema] = (
                self._writer.register_schema(channel.schema, channel.schema_encoding, channel.definition)
                if named
                else 0
            )
        metadata = dict(channel.metadata)
        if channel.topic in self._latching and _QOS in metadata:
            metadata[_QOS] = _LATCHES
        key = (channel.topic, channel.encoding, self._schemas[schema], tuple(sorted(metadata.items())))
        if key not in self._ids:
            self._ids[key] = self._writer.register_channel(
                channel.topic, channel.encoding, self._schemas[schema], metadata
            )
        if len(self._known) > 4 * len(self._ids) + 64:
            self._known.clear()
        self._known[id(channel)] = channel, self._ids[key]
        return self._ids[key]


def cut(
    ring: Source,
    incident: Incident,
    path: Path,
    *,
    compression: str,
    limit: int | None,
    losses: Losses,
    pause: Callable[[], object],
    has_room: Callable[[], object],
) -> Cut:
    """Write the file; it has ``.part`` after its name. ``pause`` is called often, and may raise, as
    ``has_room`` does. Raises `TooLargeError` beyond ``limit`` bytes, and `OSError`."""
    part = path.with_name(path.name + PART)
    account = Account()
    descriptor = os.open(part, os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_NOFOLLOW | os.O_CLOEXEC, 0o600)
    with os.fdopen(descriptor, "wb") as file:
        out = _Hashed(file, limit)
        # Optional, and asked for by the ring before.
        mcap = importlib.import_module("mcap.writer")
        kind = mcap.CompressionType
        how = kind.NONE if compression == NONE else kind.ZSTD if compression == ZSTD else kind.LZ4
        writer = mcap.Writer(out, compression=how)
        has_room()
        for i, _ in enumerate(_copied(ring, incident, writer, account)):
            if not i % _BURST:
                pause()
            if not i % _ROOM_EVERY:
                has_room()
        drops = ring.drops(incident.ring_from_us, incident.ring_to_us)
        lost = losses.between(incident.ring_from_us, incident.ring_to_us)
        topics = account.close(drops, lost, partial(fits, incident.topics or ["*"]))
        account.late_us = max(0, ring.since_us() - incident.ring_from_us)
        writer.add_metadata(ABOUT_RECORD, _about(incident, account, losses))
        writer.add_metadata(ACCOUNT_RECORD, {topic: json.dumps(counts) for topic, counts in topics.items()})
        writer.finish()
        file.flush()
        os.fsync(file.fileno())
        moment_ns = max(0, incident.edges[0].t_us) * 1000
        os.utime(file.fileno(), ns=(moment_ns, moment_ns))
    return Cut(out.size, out.sha256.hexdigest(), account.messages, account.missing, account.late_us)


def _copied(ring: Source, incident: Incident, writer: Any, account: Account) -> Iterator[None]:
    """Copies the messages of the window, a step each."""
    from_us, to_us, wanted = incident.ring_from_us, incident.ring_to_us, incident.topics or None
    # What the ring has not any more of the window is in force, too.
    latched = ring.latched(max(from_us, min(ring.since_us(), to_us)), wanted)
    there = _those_of_the_window(ring, incident, [message for _, message in latched.messages])
    channels = _Channels(writer, latched.topics)
    messages = ring.read(from_us - SLACK_US, to_us + SLACK_US, wanted)
    first = next(messages, None)
    # rosbags opens what says that it is ROS 2's.
    writer.start(_PROFILES.get(first.channel.encoding, "") if first is not None else "", _LIBRARY)
    for publisher, message in latched.messages:
        if _identity(message) in there:
            continue
        account.latch(publisher, message)
        _copy(writer, channels, message, max(from_us, message.ring_us))
        yield
    for message in chain([first] if first is not None else [], messages):
        kept = _is_of(incident, message)
        account.take(message, kept=kept, early=message.ring_us < from_us)
        if kept:
            _copy(writer, channels, message, message.ring_us)
        yield


def _is_of(incident: Incident, message: RingMessage) -> bool:
    """Whether a message is of the window: it came in it, or is of it by its own time."""
    came = incident.ring_from_us <= message.ring_us <= incident.ring_to_us
    return came or incident.from_us <= message.t_us <= incident.to_us


def _identity(message: RingMessage) -> tuple[object, ...]:
    return message.channel.topic, message.ring_us, message.t_us, message.data


def _those_of_the_window(
    ring: Source, incident: Incident, latched: Sequence[RingMessage]
) -> Container[tuple[object, ...]]:
    """Those latched messages that are of the window, too, and that the ring still has."""
    early_us = incident.ring_from_us - SLACK_US
    times = [one.ring_us for one in latched if one.ring_us >= early_us and _is_of(incident, one)]
    if not times:
        return ()
    found = ring.read(min(times), max(times), sorted({one.channel.topic for one in latched}))
    return {_identity(message) for message in found if _is_of(incident, message)}


def _copy(writer: Any, channels: _Channels, message: RingMessage, log_us: int) -> None:
    number, sequence = channels.id_of(message.channel), message.seq & 0xFFFFFFFF
    writer.add_message(number, log_us * 1000, message.data, message.t_us * 1000, sequence)


def _about(incident: Incident, account: Account, losses: Losses) -> Mapping[str, str]:
    first = incident.edges[0]
    return {
        "id": incident.id,
        "trigger": ", ".join(incident.triggers),
        "condition": incident.texts("when", " | "),
        "why": incident.texts("why", "; "),
        "by": incident.texts("by", ", "),
        "edge_us": str(first.t_us),
        "values": json.dumps(first.values),
        "edges": json.dumps([vars(edge) for edge in incident.edges]),
        "more_edges": str(incident.more_edges),
        "from_us": str(incident.from_us),
        "to_us": str(incident.to_us),
        "ring_from_us": str(incident.ring_from_us),
        "ring_to_us": str(incident.ring_to_us),
        "topics": json.dumps(incident.topics),
        # The incidents that have what was before, with this one's topics, if they were cut already.
        "follows": incident.follows,
        # Topic -> the latched messages before the window: publisher, and when they came (0: nobody knows).
        "latched": json.dumps(account.latched),
        "messages": str(account.messages),
        "missing": str(account.missing),
        # Before this the ring has nothing any more, or was not there yet.
        "begins_late_s": f"{account.late_us / 1e6:.3f}",
        # What the middleware lost before this agent began is not known.
        "losses_since_us": str(losses.since_us),
        # Each run of the agent: from its first message in the window to its last.
        "runs": json.dumps(account.runs),
        "pauses": json.dumps(account.pauses),
        "agent": json.dumps(incident.agent),
    }
