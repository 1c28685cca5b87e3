"""Items out of the telemetry and summary tables, a page of at most 1 MB at a time."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from decimal import Decimal
from typing import Any, TypeVar

from contract import MAX_BATCH_SPAN_US, RECORD, SECOND, T_US, TOPIC, build_topic
from station.cloud import Cloud
from station.progress import Told
from station.selection import Selection

Item = Mapping[str, Any]

# No time reaches these, see contract/.
_FIRST, _LAST = -(2**53), 2**53
_T = TypeVar("_T")


def batches(
    cloud: Cloud, selection: Selection, attributes: Sequence[str], *, scan: bool = False
) -> Iterator[Sequence[Item]]:
    """Pages of the stored batches that may hold samples of the selection's range, in order of time.

    A batch may start one batch length before the range. ``scan`` reads the whole table, every robot's,
    and has DynamoDB drop the rest: as slow and expensive as it sounds, and there to be compared with.
    """
    first = _FIRST if selection.start_us is None else selection.start_us - MAX_BATCH_SPAN_US + 1
    last = _LAST if selection.end_us is None else selection.end_us - 1
    request = _request(cloud, selection, ("TelemetryTable", T_US), (first, last), scan=scan)
    request["ExpressionAttributeNames"] |= {f"#a{i}": name for i, name in enumerate(attributes)}
    request["ProjectionExpression"] = ", ".join(f"#a{i}" for i in range(len(attributes)))
    return _pages(cloud, request, T_US, scan=scan) if first <= last else iter(())


def seconds(cloud: Cloud, selection: Selection, *, scan: bool = False) -> Iterator[Sequence[Item]]:
    """Pages of the summary's seconds that begin in the selection's range, in order of time."""
    first = _FIRST if selection.start_us is None else -(-selection.start_us // 1_000_000)
    last = _LAST if selection.end_us is None else (selection.end_us - 1) // 1_000_000
    request = _request(cloud, selection, ("SummaryTable", SECOND), (first, last), scan=scan)
    return _pages(cloud, request, SECOND, scan=scan) if first <= last else iter(())


def outermost(cloud: Cloud, robot: str, stream: str, *, newest: bool) -> int | None:
    """The time at which the oldest or newest stored batch of a stream starts; None where there is none."""
    whole = Selection(robot=robot, stream=stream)
    request = _request(cloud, whole, ("TelemetryTable", T_US), (_FIRST, _LAST), scan=False)
    request["ProjectionExpression"] = "#key"
    found = cloud.client("dynamodb").query(**request, Limit=1, ScanIndexForward=not newest)["Items"]
    return whole_part(found[0][T_US]) if found else None


def _request(
    cloud: Cloud,
    selection: Selection,
    table_and_key: tuple[str, str],
    between: tuple[int, int],
    *,
    scan: bool,
) -> dict[str, Any]:
    table, key = table_and_key
    topic = build_topic(RECORD, selection.robot, selection.stream, cloud.namespace)
    condition = "#topic = :topic AND #key BETWEEN :first AND :last"
    return {
        "TableName": cloud.output("storage", table),
        "ConsistentRead": True,
        ("FilterExpression" if scan else "KeyConditionExpression"): condition,
        "ExpressionAttributeNames": {"#topic": TOPIC, "#key": key},
        "ExpressionAttributeValues": {
            ":topic": {"S": topic},
            ":first": {"N": str(between[0])},
            ":last": {"N": str(between[1])},
        },
    }


def _pages(cloud: Cloud, request: Mapping[str, Any], key: str, *, scan: bool) -> Iterator[Sequence[Item]]:
    paginator = cloud.client("dynamodb").get_paginator("scan" if scan else "query")
    found = (page["Items"] for page in paginator.paginate(**request))
    if scan:
        # Nothing promises the order of a scan.
        yield sorted((item for items in found for item in items), key=lambda item: Decimal(item[key]["N"]))
    else:
        yield from ahead(found)


def ahead(items: Iterable[_T]) -> Iterator[_T]:
    """The items, each read while the one before is in use."""
    iterator, end = iter(items), object()
    with ThreadPoolExecutor(1) as reader:
        coming = reader.submit(next, iterator, end)
        while (item := coming.result()) is not end:
            coming = reader.submit(next, iterator, end)
            yield item  # type: ignore[misc]  # told apart from the end


def whole_part(value: Mapping[str, str]) -> int:
    """The whole part of a number that a table holds: a robot may have sent fractions of a microsecond, which
    its batch is refused for, but not its neighbours."""
    return int(Decimal(value["N"]))


def told(
    pages: Iterable[Sequence[Item]], progress: Told | None, key: str, unit_us: int = 1
) -> Iterator[Sequence[Item]]:
    """The pages, telling ``progress`` of each."""
    for items in pages:
        if progress is not None and items:
            progress(len(items), whole_part(items[-1][key]) * unit_us)
        yield items
