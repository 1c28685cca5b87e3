"""Accounts for every message of an incident: what its publisher sent in the window, what the file has, and
what excuses the rest. The file is read as foreign programs read it."""

from __future__ import annotations

import hashlib
import json
from collections import Counter, defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from mcap.exceptions import EndOfFile
from mcap.reader import NonSeekingReader, make_reader

# A killed agent loses the ring's open chunk, which is younger than that.
OPEN_US = 1_000_000
# A message comes so much later than it is sent, at most.
LATE_US = 1_000_000
# The topic whose messages are latched: whoever listens later hears the newest.
LATCHED = "/static"


class Sent(NamedTuple):
    """A message in its publisher's own record; ``t_us`` is the time, and ``stamp_us`` the one in it."""

    topic: str
    n: int
    t_us: int
    stamp_us: int
    subscribers: int
    digest: str


def sent(path: Path) -> list[Sent]:
    """Read a publisher's record."""
    rows = (line.split(" ") for line in path.read_text().splitlines())
    return [Sent(row[0], *map(int, row[1:5]), row[5]) for row in rows]


class Kept(NamedTuple):
    """An incident's file: what it says of itself, its account, the messages' hashes by topic, and the hashes
    of the latched ones before the window."""

    about: dict[str, str]
    account: dict[str, dict[str, Any]]
    digests: dict[str, Counter[str]]
    latched: list[str]

    def span(self, which: str = "") -> tuple[int, int]:
        """The window: by the samples' times, or by the ``ring_``'s."""
        return int(self.about[f"{which}from_us"]), int(self.about[f"{which}to_us"])


def kept(path: Path) -> Kept:
    """Read a file by `mcap` for Python."""
    digests: dict[str, Counter[str]] = defaultdict(Counter)
    latched: list[str] = []
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        metadata = {one.name: one.metadata for one in reader.iter_metadata()}
        account = {topic: json.loads(text) for topic, text in metadata["iort.account"].items()}
        for _, channel, message in reader.iter_messages():
            digest = hashlib.sha256(message.data).hexdigest()
            if channel.topic == LATCHED and len(latched) < account[LATCHED].get("latched", 0):
                latched.append(digest)
            else:
                digests[channel.topic][digest] += 1
    return Kept(metadata["iort.incident"], account, digests, latched)


def recovered(ring: Path) -> int:
    """How many messages a foreign reader finds in the ring of a killed agent."""
    messages = 0
    for path in sorted(ring.glob("*.mcap")):
        with path.open("rb") as file:
            try:
                for _ in NonSeekingReader(file).iter_messages(log_time_order=False):
                    messages += 1
            except EndOfFile:
                pass  # the segment that was open
    return messages


@dataclass(frozen=True)
class Window:
    """The account of an incident, in messages: ``dead`` ones were sent when no agent was there, or were in
    the killed one's open chunk; ``named`` ones are missing by the file's own account. ``latched`` ones are
    in force at the begin, and ``unlatched`` ones should be, or should not."""

    name: str
    path: Path
    edges: int
    published: int
    kept: int
    missing: int
    dead: int
    named: int
    extra: int
    why: dict[str, int]
    latched: int
    unlatched: int
    bucket_s: float = 0.0

    @property
    def unexplained(self) -> int:
        """How many are missing without a cause, or were never published."""
        return max(0, self.missing - self.dead - self.named) + self.extra + self.unlatched


def window(name: str, path: Path, publishers: Sequence[Sequence[Sent]], killed_us: int | None) -> Window:
    """Compare a file with the publishers' records.

    The window is that of the samples' times. Where the clock was set in it, the ring's time tells which
    messages of the same stamp came in it.
    """
    file = kept(path)
    published = missing = dead = extra = 0
    for topic, found in file.digests.items():
        everything = Counter(one.digest for sent_ in publishers for one in sent_ if one.topic == topic)
        # A killed agent may not remember which latched ones it has heard.
        known = found.keys() - everything.keys()
        extra += len(known) if topic == LATCHED else (found - everything).total()
        for sent_ in publishers:
            own = [one for one in sent_ if one.topic == topic]
            due = [one for one in own if _due(one, file)]
            left = [one for one in due if not found[one.digest]]
            published, missing = published + len(due), missing + len(left)
            if killed_us is not None:
                gone = {one.n for one in _dead(own, killed_us)}
                dead += sum(one.n in gone for one in left)
    why: Counter[str] = Counter()
    for counts in file.account.values():
        why.update(counts.get("why", {}))
    return Window(
        name,
        path,
        edges=len(json.loads(file.about["edges"])),
        published=published,
        kept=sum(map(Counter.total, file.digests.values())) + len(file.latched),
        missing=missing,
        dead=dead,
        named=why.total(),
        extra=extra,
        why=dict(why),
        latched=len(file.latched),
        unlatched=_unlatched(file, publishers),
    )


def _unlatched(file: Kept, publishers: Sequence[Sequence[Sent]]) -> int:
    """How many latched messages were surely in force at the window's begin and are not in the file, or were
    never published before it."""
    from_us, _ = file.span("ring_")
    before = set()
    due = set()
    for own in publishers:
        sent_ = [one for one in own if one.topic == LATCHED]
        before |= {one.digest for one in sent_ if one.t_us < from_us}
        # The next one may have come just before the begin.
        if not any(from_us - LATE_US < one.t_us < from_us for one in sent_):
            due |= {one.digest for one in [one for one in sent_ if one.t_us < from_us][-1:]}
    there = {*file.latched}
    return len(due - there) + len(there - before)


def _due(one: Sent, file: Kept) -> bool:
    """Whether a message is of the window: by its stamp, or surely by the time at which it came."""
    if one.topic == LATCHED and one.n == 0:
        return False  # nobody listened yet
    (from_us, to_us), (ring_from_us, ring_to_us) = file.span(), file.span("ring_")
    by_stamp = from_us <= one.stamp_us <= to_us
    if by_stamp and ring_from_us - LATE_US <= one.t_us <= ring_to_us + LATE_US:
        return True
    return ring_from_us + LATE_US <= one.t_us <= ring_to_us - LATE_US


def _dead(own: Sequence[Sent], killed_us: int) -> Iterable[Sent]:
    """The messages of a publisher that nobody heard: until more subscribers than before are there."""
    before = None
    for one in own:
        if one.t_us < killed_us - OPEN_US:
            continue
        if one.t_us > killed_us and before is not None and one.subscribers > before:
            return
        before = one.subscribers
        yield one


def table(windows: Sequence[Window]) -> str:
    """The accounts as text, a line for each incident."""
    head = (
        "window",
        "edges",
        "published",
        "kept",
        "missing",
        "dead",
        "named",
        "extra",
        "latched",
        "unexplained",
        "in the bucket",
    )
    cells = [
        head,
        *(
            (
                one.name,
                *(f"{n:,}" for n in (one.edges, one.published, one.kept, one.missing, one.dead, one.named)),
                *(f"{n:,}" for n in (one.extra, one.latched, one.unexplained)),
                f"{one.bucket_s:.1f} s after it",
            )
            for one in windows
        ),
    ]  # fmt: skip
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    return "\n".join(
        "  ".join(f"{cell:{'>' if i else '<'}{widths[i]}}" for i, cell in enumerate(line)) for line in cells
    )
