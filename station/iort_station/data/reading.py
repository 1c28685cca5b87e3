"""Items out of the telemetry and summary tables, a page of at most 1 MB at a time."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from decimal import Decimal
from typing import Any, TypeVar

from iort_contract.limits import MAX_BATCH_SPAN_US, ContractError
from iort_contract.messages.batch import batch_id, batches_between
from iort_contract.tables import BATCH, SECOND, TOPIC
from iort_contract.topics import RECORD, build_topic
from iort_station.cloud import Cloud
from iort_station.data.selection import Selection

Item = Mapping[str, Any]
# Hears how many items a page had, and the microseconds at which the last of them starts.
Told = Callable[[int, int], None]

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
    first_us = None if selection.start_us is None else selection.start_us - MAX_BATCH_SPAN_US + 1
    last_us = None if selection.end_us is None else selection.end_us - 1
    first, last = batches_between(first_us, last_us)
    request = _request(cloud, selection, ("TelemetryTable", BATCH), ({"S": first}, {"S": last}), scan=scan)
    request["ExpressionAttributeNames"] |= {f"#a{i}": name for i, name in enumerate(attributes)}
    request["ProjectionExpression"] = ", ".join(f"#a{i}" for i in range(len(attributes)))
    return _pages(cloud, request, BATCH, scan=scan) if first <= last else iter(())


def seconds(cloud: Cloud, selection: Selection, *, scan: bool = False) -> Iterator[Sequence[Item]]:
    """Pages of the summary's seconds that begin in the selection's range, in order of time."""
    first = _FIRST if selection.start_us is None else -(-selection.start_us // 1_000_000)
    last = _LAST if selection.end_us is None else (selection.end_us - 1) // 1_000_000
    between = ({"N": str(first)}, {"N": str(last)})
    request = _request(cloud, selection, ("SummaryTable", SECOND), between, scan=scan)
    return _pages(cloud, request, SECOND, scan=scan) if first <= last else iter(())


def outermost(cloud: Cloud, robot: str, stream: str, *, newest: bool) -> int | None:
    """The time at which the oldest or newest stored batch of a stream starts; None where there is none."""
    whole = Selection(robot=robot, stream=stream)
    first, last = batches_between(None, None)
    request = _request(cloud, whole, ("TelemetryTable", BATCH), ({"S": first}, {"S": last}), scan=False)
    request["ProjectionExpression"] = "#key"
    found = cloud.client("dynamodb").query(**request, Limit=1, ScanIndexForward=not newest)["Items"]
    return time_of(found[0]) if found else None


def _request(
    cloud: Cloud,
    selection: Selection,
    table_and_key: tuple[str, str],
    between: tuple[Mapping[str, str], Mapping[str, str]],
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
            ":first": between[0],
            ":last": between[1],
        },
    }


def _pages(cloud: Cloud, request: Mapping[str, Any], key: str, *, scan: bool) -> Iterator[Sequence[Item]]:
    paginator = cloud.client("dynamodb").get_paginator("scan" if scan else "query")
    found = (page["Items"] for page in paginator.paginate(**request))
    if scan:
        # Nothing promises the order of a scan.
        yield sorted((item for items in found for item in items), key=lambda item: _sorted_by(item[key]))
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


def _sorted_by(value: Mapping[str, str]) -> Any:
    return Decimal(value["N"]) if "N" in value else value["S"]


def time_of(item: Item) -> int:
    """When a stored batch or second begins, in microseconds; 0 where nobody can tell."""
    try:
        return batch_id(item[BATCH]["S"]).t_us if BATCH in item else int(item[SECOND]["N"]) * 1_000_000
    except (ContractError, KeyError, ValueError):
        return 0


def told(pages: Iterable[Sequence[Item]], progress: Told | None) -> Iterator[Sequence[Item]]:
    """The pages, telling ``progress`` of each."""
    for items in pages:
        if progress is not None and items:
            progress(len(items), time_of(items[-1]))
        yield items
