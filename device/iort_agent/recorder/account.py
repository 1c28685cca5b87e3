"""What is missing in a window, and why: the account of completeness that an incident's file carries.

The ring numbers the messages of a stream, so a gap is a loss, and tells what it dropped and why. The sources
report what never came to the agent, such as messages that the middleware has lost; their counts are looked at
once a second, and remembered for as long as a window may be."""

from __future__ import annotations

from collections import deque
from typing import Any, Callable, Mapping, Sequence, Tuple

from iort_agent.recorder.ring import EVERY, Drop, RingMessage
from iort_contract.messages.account import LOST

# The looks that are remembered: one a second, of which only those with news count.
_LOOKS = 4096
# A source's name, and what returns its counts.
Reports = Sequence[Tuple[str, Callable[[], Mapping[str, Any]]]]
# Topic -> cause -> messages.
Counted = Mapping[str, Mapping[str, int]]


class Losses:
    """What the sources say that they have lost, over the ring's time: by topic, or else by the source's name.
    ``since_us`` is when this began: what was lost before is known to nobody."""

    def __init__(self, reports: Reports, now_us: int) -> None:
        self._reports, self.since_us = reports, now_us
        self._looks: deque[tuple[int, Counted]] = deque([(now_us, {})], maxlen=_LOOKS)

    def look(self, now_us: int) -> None:
        """Note the counts, if they have changed; called about once a second."""
        counted: dict[str, Mapping[str, int]] = {}
        for source, report in self._reports:
            told = dict(report())
            topics = {name: counts for name, counts in told.items() if isinstance(counts, Mapping)}
            others = {name: count for name, count in told.items() if name not in topics}
            lost = {name: _lost(counts) for name, counts in (*topics.items(), (source, others))}
            counted.update({name: counts for name, counts in lost.items() if counts})
        if counted != self._looks[-1][1]:
            self._looks.append((now_us, counted))

    def between(self, from_us: int, to_us: int) -> Counted:
        """What was lost between two times, and up to a second before and after."""
        before: Counted = {}
        after: Counted = self._looks[-1][1]
        # A copy, since `look` is for another thread.
        for at_us, counted in [*self._looks]:
            if at_us <= from_us:
                before = counted
            elif at_us >= to_us:
                after = counted
                break
        more = {
            topic: {cause: n - before.get(topic, {}).get(cause, 0) for cause, n in counts.items()}
            for topic, counts in after.items()
        }
        lost = {topic: {cause: n for cause, n in counts.items() if n > 0} for topic, counts in more.items()}
        return {topic: counts for topic, counts in lost.items() if counts}


def _lost(counts: Mapping[str, Any]) -> dict[str, int]:
    """The losses in a topic's counts; some are counted by field."""
    lost: dict[str, int] = {}
    for cause, count in counts.items():
        total = sum(count.values()) if isinstance(count, Mapping) else count
        if cause in LOST and type(total) is int and total:
            lost[cause] = total
    return lost


class _Run:
    """The numbers of a topic's messages in one run: the first and last of the window, how many are between
    them, and the numbers that came just before and just after the window."""

    def __init__(self) -> None:
        self._first, self._last, self._count = 2**62, -1, 0
        self._before: list[int] = []
        self._after: list[int] = []

    def take(self, seq: int, *, kept: bool, early: bool) -> None:
        if kept:
            self._first, self._last = min(self._first, seq), max(self._last, seq)
            self._count += 1
        else:
            (self._before if early else self._after).append(seq)

    def gap(self) -> int:
        """How many numbers of the window are nobody's; of a gap at its end, all may be of the window."""
        first = min(self._first, max(self._before, default=2**62))
        last = max(self._last, min(self._after, default=-1))
        there = sum(first <= seq <= last for seq in (*self._before, *self._after))
        return max(0, last - first + 1 - self._count - there)


class _Topic:
    """What came of a topic: the messages of the window, and their numbers by run."""

    def __init__(self, stream: str) -> None:
        self.stream, self.messages = stream, 0
        self._runs: dict[tuple[str, str, bytes], _Run] = {}

    def take(self, message: RingMessage, *, kept: bool, early: bool) -> None:
        # Each type of a topic is numbered by itself.
        numbered = message.channel.run, message.channel.schema, message.channel.definition
        run = self._runs.get(numbered)
        if run is None:
            run = self._runs[numbered] = _Run()
        run.take(message.seq, kept=kept, early=early)
        self.messages += kept

    def gaps(self) -> int:
        return sum(run.gap() for run in self._runs.values())


class Account:
    """The account of one window, made while its messages are copied."""

    def __init__(self) -> None:
        self._topics: dict[str, _Topic] = {}
        self.messages = self.missing = self.late_us = 0
        # Run of the agent -> its first and last time in the window, and when nobody listened between them.
        self.runs: dict[str, list[int]] = {}
        self.pauses: list[tuple[int, int, str]] = []
        # Topic -> the latched messages before the window: who published them, and when they came.
        self.latched: dict[str, list[tuple[str, int]]] = {}

    def take(self, message: RingMessage, *, kept: bool, early: bool) -> None:
        """Count a message of the window; those just outside of it, ``early`` or later, tell of gaps at its
        ends."""
        channel = message.channel
        topic = self._topics.get(channel.topic)
        if topic is None:
            topic = self._topics[channel.topic] = _Topic(channel.stream)
        topic.take(message, kept=kept, early=early)
        self.messages += kept
        run = self.runs.setdefault(channel.run, [message.ring_us, message.ring_us])
        run[0], run[1] = min(run[0], message.ring_us), max(run[1], message.ring_us)

    def latch(self, publisher: str, message: RingMessage) -> None:
        """Note a latched message that is in force at the window's begin; it is none of the window."""
        channel = message.channel
        self._topics.setdefault(channel.topic, _Topic(channel.stream))
        self.latched.setdefault(channel.topic, []).append((publisher, message.ring_us))

    def close(
        self, drops: Sequence[Drop], losses: Counted, wanted: Callable[..., bool]
    ) -> dict[str, dict[str, Any]]:
        """Each topic: its messages, and the missing ones by cause."""
        dropped: dict[str, dict[str, int]] = {}
        topics = {name: topic.stream for name, topic in self._topics.items()}
        for drop in drops:
            if drop.topic == EVERY:
                # Nobody listened: how many there were, nobody knows.
                self.pauses.append((drop.from_us, drop.to_us, drop.why))
            elif drop.topic in topics or wanted(drop.topic, drop.stream):
                topics.setdefault(drop.topic, drop.stream)
                by_why = dropped.setdefault(drop.topic, {})
                by_why[drop.why] = by_why.get(drop.why, 0) + drop.messages
        topics.update({name: "" for name in losses if name not in topics and wanted(name)})
        account: dict[str, dict[str, Any]] = {}
        for name, stream in topics.items():
            topic = self._topics.get(name) or _Topic(stream)
            causes = dict(dropped.get(name, {}))
            # A gap that the ring tells no reason of: a damaged or evicted segment.
            if (unknown := topic.gaps() - sum(causes.values())) > 0:
                causes["not_in_ring"] = unknown
            causes.update(losses.get(name, {}))
            account[name] = {
                "stream": stream,
                "messages": topic.messages,
                "missing": sum(causes.values()),
                **({"latched": len(self.latched[name])} if name in self.latched else {}),
                **({"why": causes} if causes else {}),
            }
            self.missing += sum(causes.values())
        return account
