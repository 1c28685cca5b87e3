"""What is recorded of a stream, and which of it a query asks for: in table and archive of a deployment.

`iort_analysis.archive.stored` merges table and archive; this module gives it a deployment's.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from iort_analysis.archive.hours import Archive, Stores
from iort_analysis.archive.stored import AUTO, Origin, Source, Stored
from iort_analysis.samples.batches import RefusedItems
from iort_contract import dynamodb, expression
from iort_contract.archive import ArchiveTable
from iort_contract.catalog.derived import SOURCES
from iort_contract.expression import ExpressionError, Node
from iort_contract.limits import ContractError
from iort_contract.topics import RECORD, build_topic, check_robot, check_stream
from iort_station.cloud import Cloud
from iort_station.errors import StationError, UsageError
from iort_station.times import Time, time_us


@dataclass(frozen=True, kw_only=True)
class Selection:
    """A stream's samples from ``start_us`` (inclusive) to ``end_us`` (exclusive) that meet a condition.

    ``fields`` are the fields to return; None means all. ``where`` is the condition's text.
    """

    robot: str
    stream: str
    start_us: int | None = None
    end_us: int | None = None
    fields: tuple[str, ...] | None = None
    where: str | None = None
    condition: Node | None = field(default=None, repr=False)

    def named(self) -> frozenset[str]:
        """The fields that the selection names, in its list or in its condition."""
        deciding = expression.names(self.condition) if self.condition is not None else frozenset()
        return deciding.union(self.fields or ())

    def wanted(self) -> Callable[[str], bool]:
        """Which stored fields the answer needs."""
        if self.fields is None:
            return lambda _name: True
        named = self.named()
        return named.union(*(SOURCES[name] for name in named & SOURCES.keys())).__contains__

    def holds_time(self, t_us: int) -> bool:
        """Whether the range includes a time."""
        return (self.start_us is None or self.start_us <= t_us) and (
            self.end_us is None or t_us < self.end_us
        )


def select(
    robot: str,
    stream: str,
    start: Time | None = None,
    end: Time | None = None,
    *,
    fields: Sequence[str] | None = None,
    where: str | None = None,
) -> Selection:
    """Make a selection from times and a condition as people write them; raises `UsageError`."""
    now_us = time.time_ns() // 1000
    try:
        check_robot(robot)
        check_stream(stream)
        condition = expression.parse(where) if where is not None else None
    except (ContractError, ExpressionError) as error:
        raise UsageError(str(error)) from error
    start_us = None if start is None else time_us(start, now_us)
    end_us = None if end is None else time_us(end, now_us)
    if start_us is not None and end_us is not None and start_us > end_us:
        raise UsageError("the range ends before it starts")
    return Selection(
        robot=robot,
        stream=stream,
        start_us=start_us,
        end_us=end_us,
        fields=None if fields is None else tuple(dict.fromkeys(fields)),
        where=where,
        condition=condition,
    )


def telemetry_table(cloud: Cloud) -> dynamodb.TelemetryTable:
    """The deployment's telemetry table."""
    return dynamodb.TelemetryTable(cloud.client("dynamodb"), cloud.output("storage", "TelemetryTable"))


def summary_table(cloud: Cloud) -> dynamodb.SummaryTable:
    """The deployment's summary table."""
    return dynamodb.SummaryTable(cloud.client("dynamodb"), cloud.output("storage", "SummaryTable"))


def topic_of(cloud: Cloud, robot: str, stream: str) -> str:
    """The topic of a robot's stream on the record lane."""
    return build_topic(RECORD, robot, stream, cloud.namespace)


class Recorded(Stored):
    """The batches of a robot's stream. ``origin`` and ``refused`` grow while they are read."""

    def __init__(
        self,
        cloud: Cloud,
        robot: str,
        stream: str,
        *,
        source: Source = AUTO,
        origin: Origin | None = None,
        refused: RefusedItems | None = None,
    ) -> None:
        topic = topic_of(cloud, robot, stream)
        super().__init__(stores(cloud), topic, source=source, origin=origin, refused=refused)


def archive_of(cloud: Cloud, topic: str) -> Archive:
    """The archive of a topic."""
    return Archive(stores(cloud), topic)


def stores(cloud: Cloud) -> Stores:
    """Where a deployment's recordings are."""
    manifest = ArchiveTable(cloud.client("dynamodb"), cloud.output("storage", "ArchiveTable"))
    return Stores(
        telemetry_table(cloud), manifest, lambda: (cloud.client("s3"), cloud.output("storage", "FilesBucket"))
    )


# A write unit writes a kilobyte. AWS accepts 1,000 a second for a partition, which holds a whole topic. Half
# of them are left to the robot.
UNITS_PER_S = 500
_UNIT_BYTES = 1024


def write(table: dynamodb.TelemetryTable, items: Sequence[Mapping[str, Any]], units_per_s: int) -> None:
    """Write items at so many write units a second; raises `StationError` if DynamoDB rejects them."""
    for start in range(0, len(items), dynamodb.WRITE_ITEMS):
        part, began = items[start : start + dynamodb.WRITE_ITEMS], time.monotonic()
        try:
            table.put(part)
        except dynamodb.TableError as error:
            raise StationError(f"{error}; do it again, or with fewer --units") from error
        # About the units of an item, which is nearly all samples.
        units = sum(-(-len(str(item)) // _UNIT_BYTES) for item in part)
        time.sleep(max(0.0, began + units / units_per_s - time.monotonic()))
