"""Compares a stream on both sides: each batch of the source must be in the target, with the same content.

Both are read as `iort audit` and `iort query` read them: from the table, the archive, or both. The target may
have more, from a robot that records into it already.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

from iort_analysis.archive.hours import key_of
from iort_analysis.archive.stored import HEADER
from iort_contract.archive import HASH, content_hash, item_hash
from iort_contract.dynamodb import starting_between
from iort_contract.tables import ENVELOPE
from iort_station.cloud import Cloud
from iort_station.data.recorded import Recorded
from iort_station.errors import StationError
from iort_station.moving.recorded import BatchProgress
from iort_station.operations.delivery.audit import Audit, audit


@dataclass(frozen=True)
class Compared:
    """The source's batches, the hash over their contents, and their audit; how many of them are ``lacking``
    or ``different`` in the target, and how many ``more`` it has.

    An audit follows from what the hash covers, so the target's audit of the same batches is the same.
    """

    batches: int
    content: str
    audit: Audit
    lacking: int
    different: int
    more: int

    @property
    def problem(self) -> str:
        """What is wrong in the target; empty if nothing is."""
        if self.lacking:
            return f"the target lacks {self.lacking:,} of {self.batches:,} batches: move again"
        return f"{self.different:,} batches have another content in the target" if self.different else ""


class _Batch(NamedTuple):
    key: str
    hash: str
    header: dict[str, Any]


def compare(
    source: Cloud, target: Cloud, robot: str, stream: str, progress: BatchProgress = lambda _batches: None
) -> Compared:
    """Read a stream on both sides, wherever its batches are, and compare them."""
    theirs = _batches(target, robot, stream, progress)
    hashes: list[tuple[str, str]] = []
    lacking = different = more = 0

    def matched() -> Iterator[dict[str, Any]]:
        nonlocal lacking, different, more
        their = next(theirs, None)
        for one in _batches(source, robot, stream, progress):
            while their is not None and their.key < one.key:
                their, more = next(theirs, None), more + 1
            if their is None or their.key > one.key:
                lacking += 1
            else:
                different += their.hash != one.hash
                their = next(theirs, None)
            hashes.append((one.key, one.hash))
            yield one.header
        more += (their is not None) + sum(1 for _ in theirs)

    audited = audit(stream, matched())
    return Compared(len(hashes), content_hash(hashes), audited, lacking, different, more)


def _batches(cloud: Cloud, robot: str, stream: str, progress: BatchProgress) -> Iterator[_Batch]:
    attributes = tuple({*ENVELOPE, *HEADER, HASH})
    recorded = Recorded(cloud, robot, stream)
    for items in recorded.items(starting_between(None, None), attributes):
        progress(len(items))
        for item in items:
            header = {name: next(iter(item[name].values())) for name in HEADER if name in item}
            yield _Batch(key_of(item), item_hash(dict(item)), header)
    if recorded.refused.count:
        raise StationError(f"{stream} cannot be compared: {recorded.refused.reason}")
