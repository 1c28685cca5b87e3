"""A stream of a drive from its stored batches, with notes about what is missing among them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np

from iort_analysis.samples.batches import Item, RefusedItems, blocks
from iort_analysis.samples.blocks import EMPTY, Block, join
from iort_contract.limits import ContractError
from iort_contract.messages.analysis import DriveKey
from iort_contract.messages.batch import BatchId, batch_id
from iort_contract.tables import BATCH

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
