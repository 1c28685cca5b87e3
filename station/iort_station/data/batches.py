"""The stored batches of a stream, read from the telemetry table."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from itertools import chain
from typing import TypeVar

from iort_analysis.samples.batches import ATTRIBUTES, Item, start_us
from iort_contract.dynamodb import SummaryTable, TelemetryTable, with_samples_between
from iort_contract.tables import BATCH
from iort_contract.topics import RECORD, build_topic
from iort_station.cloud import Cloud
from iort_station.data.selection import Selection

# Receives the number of items in a page, and the start time of its last item in microseconds.
PageProgress = Callable[[int, int], None]
_T = TypeVar("_T")


def telemetry_table(cloud: Cloud) -> TelemetryTable:
    """The deployment's telemetry table."""
    return TelemetryTable(cloud.client("dynamodb"), cloud.output("storage", "TelemetryTable"))


def summary_table(cloud: Cloud) -> SummaryTable:
    """The deployment's summary table."""
    return SummaryTable(cloud.client("dynamodb"), cloud.output("storage", "SummaryTable"))


def topic_of(cloud: Cloud, robot: str, stream: str) -> str:
    """The topic of a robot's stream on the record lane."""
    return build_topic(RECORD, robot, stream, cloud.namespace)


def stored(
    cloud: Cloud,
    selection: Selection,
    attributes: Sequence[str] = ATTRIBUTES,
    *,
    scan: bool = False,
    progress: PageProgress | None = None,
) -> Iterator[Sequence[Item]]:
    """Pages of the stored items that may hold samples of the selection, in order of time."""
    topic = topic_of(cloud, selection.robot, selection.stream)
    keys = with_samples_between(selection.start_us, selection.end_us)
    pages = telemetry_table(cloud).pages(topic, keys, attributes=attributes, scan=scan)
    found: Iterator[Sequence[Item]] = (page.items for page in pages)
    if scan:
        # A scan has no order.
        found = iter([sorted(chain.from_iterable(found), key=lambda item: str(item[BATCH]["S"]))])
    for items in ahead(found):
        if progress is not None and items:
            progress(len(items), start_us(items[-1]))
        yield items


def ahead(items: Iterable[_T]) -> Iterator[_T]:
    """The items; while the caller uses one, a thread reads the next."""
    iterator, end = iter(items), object()
    with ThreadPoolExecutor(1) as reader:
        coming = reader.submit(next, iterator, end)
        while (item := coming.result()) is not end:
            coming = reader.submit(next, iterator, end)
            yield item  # type: ignore[misc]  # it is not `end`
