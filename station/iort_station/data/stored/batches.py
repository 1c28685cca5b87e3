"""The tables of recorded batches and of their seconds."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, Generic, TypeVar

from iort_contract.dynamodb import SummaryTable, TelemetryTable
from iort_contract.topics import RECORD, build_topic
from iort_station.cloud import Cloud

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


def ahead(items: Iterable[_T]) -> Iterator[_T]:
    """The items; while the caller uses one, a thread reads the next."""
    iterator, end = iter(items), object()
    with ThreadPoolExecutor(1) as reader:
        coming = reader.submit(next, iterator, end)
        while (item := coming.result()) is not end:
            coming = reader.submit(next, iterator, end)
            yield item  # type: ignore[misc]  # it is not `end`


class Pages(Generic[_T]):
    """Pages of a table's items in the order of their keys, to be taken up to some key."""

    def __init__(self, pages: Iterator[Sequence[_T]], key: Callable[[_T], Any]) -> None:
        self._pages, self._key = filter(None, pages), key
        self._rest = next(self._pages, ())

    def until(self, key: Any) -> Iterator[Sequence[_T]]:
        """The items before a key; None is all."""
        while self._rest:
            end = len(self._rest) if key is None else bisect_left(self._rest, key, key=self._key)
            if end:
                yield self._rest[:end]
            if end < len(self._rest):
                self._rest = self._rest[end:]
                return
            self._rest = next(self._pages, ())
