"""Finds the drives in a stream's batches: runs of the agent, cut where the car stood for long, or went on for
hours.

It looks at one batch in many: a stand of a minute cannot hide between two looks that are closer together.
Looks and cuts are at times of the clock, so that a drive has the same start wherever the reading began."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from iort_analysis.samples.batches import Item, RefusedItems, blocks
from iort_analysis.samples.blocks import EMPTY, Block, join
from iort_contract.limits import MAX_BATCH_SPAN_US, ContractError
from iort_contract.messages.analysis import DriveKey
from iort_contract.messages.batch import BatchId, batch_id
from iort_contract.tables import BATCH

# A stand, or a pause in the recording, of this length ends a drive.
STAND_US = 60_000_000
# A drive keeps this much of the stands around it: there the battery rests, and sensors show their zero.
_AROUND_US = 10_000_000
# A robot that never stands, or of which nothing tells, has drives of this length; one that stands has at most
# twice this. One function call analyses a drive, in its memory and time.
LONGEST_US = 2 * 3_600_000_000
# How far apart looks are while the car moves, and while it stands.
_LOOK_MOVING_US, _LOOK_STANDING_US = 15_000_000, 3_000_000


class Heard(NamedTuple):
    """A batch of the stream that tells of motion; ``moves`` decodes it."""

    id: BatchId
    moves: Callable[[], bool]


class Stretch(NamedTuple):
    """A drive: its first and last batch start at these times, in one run."""

    start_us: int
    last_us: int
    run: str


def find(batches: Iterable[Heard], until_us: int | None = None) -> Iterator[Stretch]:
    """The drives in batches in order of time, that begin before ``until_us``.

    A drive begins with the run or some seconds before the car moves, and ends alike. Runs that recorded at
    the same time are apart. No more batches are read than the last drive needs.
    """
    for found in _find(batches, until_us):
        if until_us is None or found.start_us < until_us:
            yield found


def _find(batches: Iterable[Heard], until_us: int | None) -> Iterator[Stretch]:
    runs: dict[str, _Run] = {}
    for batch in batches:
        for boot, run in list(runs.items()):
            if batch.id.t_us - run.newest_us > STAND_US:
                yield from run.ended()
                del runs[boot]
        run = runs.setdefault(batch.id.boot, _Run(batch.id))
        yield from run.hear(batch)
        if until_us is None or batch.id.t_us < until_us + STAND_US:
            continue
        if not any(run.is_in_drive_before(until_us) for run in runs.values()):
            return
    for run in runs.values():
        yield from run.ended()


class _Run:
    """One run of the agent, as far as it has been heard."""

    def __init__(self, first: BatchId) -> None:
        self._boot = first.boot
        self._earliest_us = self.newest_us = first.t_us
        self._looked_us: int | None = None
        self._moving = False
        self._start_us: int | None = None
        self._moved_us = first.t_us
        # Since the last look.
        self._unseen: list[Heard] = []

    def is_in_drive_before(self, t_us: int) -> bool:
        """Whether a drive goes on that began before a time."""
        return self._start_us is not None and self._start_us < t_us

    def hear(self, batch: Heard) -> Iterator[Stretch]:
        """Take the next batch; yields the drive that a stand has just ended."""
        self.newest_us = batch.id.t_us
        apart = _LOOK_MOVING_US if self._moving else _LOOK_STANDING_US
        if self._looked_us is not None and batch.id.t_us // apart == self._looked_us // apart:
            self._unseen.append(batch)
            return
        yield from self._look(batch)

    def ended(self) -> Iterator[Stretch]:
        """The drive at the run's end, if there is one."""
        if self._unseen:
            yield from self._look(self._unseen.pop())
        if self._start_us is not None:
            yield self._drive()

    def _look(self, batch: Heard) -> Iterator[Stretch]:
        moves, unseen = batch.moves(), self._unseen
        self._looked_us, self._unseen = batch.id.t_us, []
        if moves:
            moved_us = batch.id.t_us
            if not self._moving:
                moved_us = next((one.id.t_us for one in unseen if one.moves()), moved_us)
            if self._start_us is not None and moved_us - self._moved_us > STAND_US:
                yield self._drive()
                self._start_us = None
            if self._start_us is None:
                self._start_us = max(self._earliest_us, moved_us - _AROUND_US)
            self._moved_us = batch.id.t_us
            cut_us = (-(-self._start_us // LONGEST_US) + 1) * LONGEST_US
            if cut_us <= self._moved_us:
                yield Stretch(self._start_us, cut_us - MAX_BATCH_SPAN_US, self._boot)
                self._start_us = cut_us
        elif self._moving:
            last = next((one.id.t_us for one in reversed(unseen) if one.moves()), None)
            self._moved_us = self._moved_us if last is None else last
        self._moving = moves
        if self._start_us is not None and batch.id.t_us - self._moved_us > STAND_US:
            yield self._drive()
            self._start_us = None

    def _drive(self) -> Stretch:
        assert self._start_us is not None
        last_us = min(self.newest_us, self._moved_us + _AROUND_US)
        found = Stretch(self._start_us, last_us, self._boot)
        # What belongs to this drive is not the beginning of the next one.
        self._earliest_us = last_us + 1
        return found


# A stream of a drive from its stored batches, with notes about what is missing among them.

# A clock is corrected all the time by less than this.
_SET_BACK_US = 1_000_000
# So many batches are decoded together: their lists of numbers fit in a processor's cache.
_PAGE_ITEMS = 200


@dataclass(frozen=True)
class Recorded:
    """The samples of a stream in a drive; ``notes`` says by name what is not among them, and why."""

    block: Block = EMPTY
    notes: Mapping[str, str] = field(default_factory=dict)


def recorded(drive: DriveKey, end_us: int, stream: str, items: Iterable[Item]) -> Recorded:
    """The stream's samples from a drive's start to ``end_us``, inclusive, of its run alone.

    After a clock was set back, samples of two times have the same time: the longest part counts.
    """
    notes: dict[str, str] = {}
    refused = RefusedItems(stream)
    own: list[tuple[BatchId, Item]] = []
    for item in items:
        try:
            found = batch_id(item[BATCH]["S"])
        except (ContractError, KeyError, TypeError) as error:
            refused.add(error, "an unknown time")
            continue
        if found.boot == drive.run:
            own.append((found, item))
    own.sort(key=lambda one: one[0].seq)
    kept = _on_one_clock(stream, own, notes)
    if kept:
        expected = kept[-1][0].seq - kept[0][0].seq + 1
        if expected > len(kept):
            notes[f"{stream} batches"] = (
                f"{expected - len(kept)} of {expected} are not stored: `iort audit` says whether they are in "
                "quarantine or were lost"
            )
    kept.sort(key=lambda one: one[0])
    ordered = [item for _, item in kept]
    pages = (ordered[i : i + _PAGE_ITEMS] for i in range(0, len(ordered), _PAGE_ITEMS))
    block = join(list(blocks(pages, refused)))
    if refused.count:
        notes[f"{stream} items"] = f"{refused.count} cannot be decoded; the first: {refused.reason}"
    times = block.times_us
    inside = slice(*np.searchsorted(times, [drive.start_us, end_us + 1]).tolist())
    return Recorded(block.take(inside), notes)


def _on_one_clock(
    stream: str, own: Sequence[tuple[BatchId, Item]], notes: dict[str, str]
) -> list[tuple[BatchId, Item]]:
    """The longest part of the batches, in order of their numbers, in which time does not go back."""
    cuts = [
        place
        for place, ((before, _), (after, _)) in enumerate(pairwise(own), 1)
        if after.t_us < before.t_us - _SET_BACK_US
    ]
    if not cuts:
        return list(own)
    edges = [0, *cuts, len(own)]
    first, last = max(pairwise(edges), key=lambda part: part[1] - part[0])
    back_s = max(own[i - 1][0].t_us - own[i][0].t_us for i in cuts) / 1e6
    notes[f"{stream} clock"] = (
        f"the clock was set back by {back_s:,.1f} s: {len(own) - (last - first)} of {len(own)} batches have "
        "times that others have too, and are left out"
    )
    return list(own[first:last])
