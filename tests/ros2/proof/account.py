"""Accounts for every message of a drive: what its publisher sent, what was stored, what excuses the rest."""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, NamedTuple

from mcap.reader import make_reader
from rosbags.rosbag2 import Reader

# A killed agent loses its open batches, which are one second long, and on a busy machine what it has not yet
# read: at most so much.
OPEN_S, LAG_S = 2.5, 8.0
# It remembers a latched message once that is surely in its queue; until then, it rather takes it twice.
UNSETTLED_S = 5.0


def whole(data: bytes) -> bytes:
    """Return the bytes as Fast DDS gives them to another process: filled with zeros to a multiple of four."""
    return data + bytes(-len(data) % 4)


class Sent(NamedTuple):
    """A message in its publisher's own record."""

    t_ns: int
    data: bytes


class Contents(NamedTuple):
    """What a recording has: type and definition by topic, and the messages' bytes."""

    kinds: dict[str, tuple[str, str]]
    messages: dict[str, list[bytes]]


def bag(folder: Path) -> Contents:
    """Read what `ros2 bag record` wrote."""
    found = Contents({}, {})
    with Reader(folder) as reader:
        for connection in reader.connections:
            found.kinds[connection.topic] = (connection.msgtype, str(connection.msgdef.data))
        for connection, _, data in reader.messages():
            found.messages.setdefault(connection.topic, []).append(bytes(data))
    return found


def exported(files: Iterable[Path]) -> Contents:
    """Read exported MCAP files as one."""
    found = Contents({}, {})
    for file in files:
        with file.open("rb") as stream:
            for schema, channel, message in make_reader(stream).iter_messages():
                assert schema is not None
                assert (channel.message_encoding, schema.encoding) == ("cdr", "ros2msg"), channel.topic
                found.kinds[channel.topic] = (schema.name, schema.data.decode())
                found.messages.setdefault(channel.topic, []).append(message.data)
    return found


class Publisher(NamedTuple):
    """One publisher's messages. ``back`` is the number of the first one that it sent after it had found the
    agent that followed the killed one; None if it had no message for that.
    """

    sent: Sequence[Sent]
    back: int | None


@dataclass(frozen=True)
class Row:
    """A topic's account, in messages. ``dead`` were published while no agent was there, ``open`` were in the
    killed agent's open batches; ``named`` is what the middleware or the audit reports as lost. ``again`` are
    the latched ones from just before the kill that came twice.
    """

    topic: str
    kind: str
    published: int
    stored: int
    recorded: int
    missing: int
    dead: int
    open: int
    named: int
    extra: int
    again: int
    unrecorded: int
    difference: str = ""

    @property
    def unexplained(self) -> int:
        """How many messages are missing without a cause, or were stored without having been published."""
        return max(0, self.missing - self.dead - self.open - self.named) + self.extra - self.again

    def as_json(self) -> dict[str, Any]:
        return {**asdict(self), "unexplained": self.unexplained}


class Kill(NamedTuple):
    """When the agent was killed, and when every publisher that tells had found the next one."""

    killed_ns: int
    back_ns: int


class Account(NamedTuple):
    """What was stored and recorded of a drive with a killed agent."""

    stored: Contents
    recorded: Contents
    kill: Kill

    def row(self, topic: str, kind: str, publishers: Sequence[Publisher], named: int, latched: bool) -> Row:
        """Return a topic's account."""
        sent = Counter(whole(one.data) for publisher in publishers for one in publisher.sent)
        came = Counter(map(whole, self.stored.messages.get(topic, ())))
        taped = Counter(map(whole, self.recorded.messages.get(topic, ())))
        left, extra = sent - came, came - sent
        opened: Counter[bytes] = Counter()
        dead: Counter[bytes] = Counter()
        since_ns = self.kill.killed_ns - UNSETTLED_S * 1e9
        unsettled = Counter(
            whole(one.data)
            for publisher in publishers
            for one in publisher.sent
            if latched and since_ns <= one.t_ns < self.kill.killed_ns
        )
        for publisher in publishers:
            before, after = _excused(publisher, self.kill, left)
            opened.update(before)
            dead.update(after)
        return Row(
            topic,
            kind,
            published=sent.total(),
            stored=came.total(),
            recorded=taped.total(),
            missing=left.total(),
            dead=(left & dead).total(),
            open=((left - dead) & opened).total(),
            named=named,
            extra=extra.total(),
            again=(extra & unsettled).total(),
            unrecorded=(sent - taped).total(),
            difference=_difference(left, extra),
        )


def _excused(publisher: Publisher, kill: Kill, left: Counter[bytes]) -> tuple[list[bytes], list[bytes]]:
    """Return the messages before and after the kill that may be missing. Before it are those of the open
    batches, and those that are missing without a break until then.
    """
    killed, open_ns, lag_ns = kill.killed_ns, OPEN_S * 1e9, LAG_S * 1e9
    earlier = [one for one in reversed(publisher.sent) if killed - lag_ns <= one.t_ns < killed]
    run = itertools.takewhile(lambda one: left[whole(one.data)] or one.t_ns >= killed - open_ns, earlier)
    if publisher.back is None:
        later = [whole(one.data) for one in publisher.sent if killed <= one.t_ns <= kill.back_ns]
    else:
        later = [whole(one.data) for one in publisher.sent[: publisher.back] if killed <= one.t_ns]
    return [whole(one.data) for one in run], later


def _difference(left: Counter[bytes], extra: Counter[bytes]) -> str:
    """Say in words how the first missing and the first other message differ."""
    if not left or not extra:
        return ""
    ours, theirs = next(iter(left)), next(iter(extra))
    at = next((i for i, (a, b) in enumerate(zip(ours, theirs, strict=False)) if a != b), "the end")
    return f"{len(ours)} bytes became {len(theirs)}, from byte {at}: {ours[:12].hex()} {theirs[:12].hex()}"


def table(rows: Sequence[Row]) -> str:
    """Return the account as text, with a line for each topic and one for all."""
    names = (
        "published",
        "stored",
        "recorded",
        "missing",
        "dead",
        "open",
        "named",
        "extra",
        "again",
        "unexplained",
    )
    head = ("topic", "type", *names[:2], "in the bag", *names[3:])
    cells = [(r.topic, r.kind, *(f"{getattr(r, name):,}" for name in names)) for r in rows]
    sums = (f"{sum(getattr(r, name) for r in rows):,}" for name in names)
    cells = [head, *cells, (f"{len(rows)} topics", f"{len({r.kind for r in rows})} types", *sums)]
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    aligned = ("<", "<", *">" * len(names))
    return "\n".join(
        "  ".join(
            f"{cell:{side}{width}}" for cell, side, width in zip(line, aligned, widths, strict=True)
        ).rstrip()
        for line in cells
    )
