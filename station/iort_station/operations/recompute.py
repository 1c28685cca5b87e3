"""Recomputes summaries from the stored batches, after a correction of the vehicle parameters."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

from iort_analysis.archive.stored import TABLE, PageProgress
from iort_analysis.samples.batches import Item
from iort_contract import tables
from iort_contract.catalog.streams import OWN_STREAMS
from iort_contract.dynamodb import with_samples_between
from iort_station.cloud import Cloud
from iort_station.data import inventory
from iort_station.data.recorded import Recorded, Selection
from iort_station.data.seconds import stored_seconds
from iort_station.errors import StationError
from iort_station.operations.quarantine import summarize

# Lambda 2 caches the old parameters for this long; the margin is for its running invocations.
SETTLED_S = tables.VEHICLE_CACHE_S + 5
# The attributes of a batch that Lambda 2 would get from the table's stream.
_IMAGE = (*tables.ENVELOPE, tables.TOPIC, tables.ROBOT, tables.RECEIVED_MS, tables.EXPIRES_S)
# An event may have 6 MB, and takes a second or two.
_AT_ONCE, _EVENT_BATCHES, _EVENT_BYTES = 4, 100, 2_000_000


class Recomputed(NamedTuple):
    """The number of seconds written, and of stored items that cannot be summarised."""

    seconds: int
    left_out: int


def wait_until_settled() -> None:
    """Wait until Lambda 2 no longer uses the old parameters."""
    threading.Event().wait(SETTLED_S)


def streams(cloud: Cloud, robot: str, since_us: int | None) -> list[str]:
    """The robot's known streams whose summary has a speed."""
    known = (name for name in inventory.streams_of(cloud, robot) if name not in OWN_STREAMS)
    return [name for name in known if _has_speed(cloud, _from(robot, name, since_us))]


def recompute(
    cloud: Cloud, robot: str, stream: str, since_us: int | None, *, progress: PageProgress | None = None
) -> Recomputed:
    """Have Lambda 2 summarise a stream again, from the second of ``since_us`` on; None means everything.

    Raises `StationError` if Lambda 2 fails; the seconds written so far are correct. It may be run again.
    """
    selection = _from(robot, stream, since_us)
    event = {tables.RECOMPUTE_FROM_S: 0 if selection.start_us is None else selection.start_us // 1_000_000}
    # Seconds expire with their batches, so those of the archive's batches have nothing to be corrected.
    recorded = Recorded(cloud, robot, stream, source=TABLE)
    pages = recorded.items(with_samples_between(selection.start_us, None), _IMAGE, progress=progress)
    # Neighbouring events may write the same second, with the same content.
    seconds: set[int] = set()
    left_out = 0

    def count(answer: dict[str, Any]) -> None:
        nonlocal left_out
        if tables.RECOMPUTED not in answer:
            raise StationError("Lambda 2 cannot recompute: deploy the current stacks")
        seconds.update(answer[tables.RECOMPUTED])
        left_out += len(answer["batchItemFailures"])

    with ThreadPoolExecutor(_AT_ONCE) as pool:
        asked: deque[Any] = deque()
        try:
            for items in _parted(pages):
                if len(asked) >= _AT_ONCE:
                    count(asked.popleft().result())
                asked.append(pool.submit(summarize, cloud, items, event))
            while asked:
                count(asked.popleft().result())
        finally:
            pool.shutdown(cancel_futures=True)
    return Recomputed(len(seconds), left_out)


def _from(robot: str, stream: str, since_us: int | None) -> Selection:
    whole_us = None if since_us is None else since_us // 1_000_000 * 1_000_000
    return Selection(robot=robot, stream=stream, start_us=whole_us)


def _has_speed(cloud: Cloud, selection: Selection) -> bool:
    pages = stored_seconds(cloud, selection)
    return any(name.startswith("speed") for items in pages for item in items for name in item)


def _parted(pages: Iterator[Sequence[Item]]) -> Iterator[list[Item]]:
    """The items, in groups that fit in an event."""
    part: list[Item] = []
    size = 0
    for items in pages:
        for item in items:
            length = len(item.get("samples", {}).get("S", "")) + 1000
            if part and (len(part) >= _EVENT_BATCHES or size + length > _EVENT_BYTES):
                yield part
                part, size = [], 0
            part.append(item)
            size += length
    if part:
        yield part
