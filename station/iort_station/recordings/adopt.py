"""Copies stored batches into the telemetry table from another one, such as a restored backup."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from decimal import Decimal
from operator import itemgetter
from typing import Any, NamedTuple

from botocore.exceptions import ClientError

from iort_analysis.archive.stored import ahead
from iort_analysis.samples.batches import Item
from iort_contract.catalog.streams import AGENT_STREAM
from iort_contract.dynamodb import WRITE_ITEMS, TableError, TelemetryTable, plain
from iort_contract.limits import ContractError
from iort_contract.messages.batch import Batch, decode_item
from iort_contract.tables import BATCH, EXPIRES_S, RECEIVED_MS, TOPIC
from iort_contract.topics import RECORD, Topic, build_topic
from iort_station.cloud import Cloud
from iort_station.errors import StationError

# A write unit writes a kilobyte. AWS accepts 1,000 a second for a partition, which holds a whole topic. Half
# of them are left to the robot.
UNITS_PER_S = 500
_UNIT_BYTES = 1024
_KEYS = [TOPIC, BATCH]


class Left(NamedTuple):
    """An item that is not adopted: its key in the table, and the cause."""

    topic: str
    key: str
    cause: str


@dataclass
class Adoption:
    """The counts of the table's items. Batches and samples are counted by robot and stream; DynamoDB has not
    yet deleted the ``expired`` items."""

    batches: Counter[tuple[str, str]] = field(default_factory=Counter)
    samples: Counter[tuple[str, str]] = field(default_factory=Counter)
    expired: int = 0
    left: list[Left] = field(default_factory=list)


def items_in(cloud: Cloud, name: str) -> int:
    """About how many items the table of that name has.

    Raises `StationError` if the table does not exist, has no batches, or is the telemetry table itself.
    """
    try:
        table = cloud.client("dynamodb").describe_table(TableName=name)["Table"]
    except ClientError as error:
        if error.response["Error"]["Code"] != "ResourceNotFoundException":
            raise
        raise StationError(f"there is no table {name}") from error
    keys = [key["AttributeName"] for key in sorted(table["KeySchema"], key=itemgetter("KeyType"))]
    if keys != _KEYS:
        raise StationError(f"the table {name} has the keys {', '.join(keys)}: must be {', '.join(_KEYS)}")
    if name == cloud.output("storage", "TelemetryTable"):
        raise StationError(f"{name} is the telemetry table itself")
    return int(table["ItemCount"])


def adopt(
    cloud: Cloud,
    table: str,
    *,
    robot: str | None = None,
    units_per_s: int = UNITS_PER_S,
    dry_run: bool = False,
    progress: Callable[[int], None] = lambda _items: None,
) -> Adoption:
    """Copy a table's items, of one robot or of all, at so many write units a second.

    Whole items are copied, so that a second time changes nothing. ``progress`` is called with the number of
    items read. Raises `StationError` if DynamoDB rejects a write; the items copied until then are good.
    """
    done = Adoption()
    new_table = TelemetryTable(cloud.client("dynamodb"), cloud.output("storage", "TelemetryTable"))
    for read, items in ahead(_pages(cloud, table, robot)):
        new = list(_adoptable(items, cloud.namespace, done))
        for start in range(0, 0 if dry_run else len(new), WRITE_ITEMS):
            write(new_table, new[start : start + WRITE_ITEMS], units_per_s)
        progress(read)
    return done


def _pages(cloud: Cloud, table: str, robot: str | None) -> Iterator[tuple[int, Sequence[Item]]]:
    """The number of items read, and the wanted ones; those of a topic are in the order of time."""
    request: dict[str, Any] = {"TableName": table, "ConsistentRead": True}
    if robot is not None:
        whole = build_topic(RECORD, robot, AGENT_STREAM, cloud.namespace)
        request["FilterExpression"] = "begins_with(#topic, :start)"
        request["ExpressionAttributeNames"] = {"#topic": TOPIC}
        request["ExpressionAttributeValues"] = {":start": {"S": whole.removesuffix(AGENT_STREAM)}}
    for page in cloud.client("dynamodb").get_paginator("scan").paginate(**request):
        yield page["ScannedCount"], page["Items"]


def _adoptable(items: Sequence[Item], namespace: str, done: Adoption) -> Iterator[Item]:
    now_s = time.time()
    for item in items:
        values = plain(item)
        expires = values.get(EXPIRES_S)
        if isinstance(expires, Decimal) and expires <= now_s:
            done.expired += 1
            continue
        try:
            topic, batch = _checked(item, namespace)
        except ContractError as error:
            done.left.append(Left(item[TOPIC]["S"], item[BATCH]["S"], str(error)))
            continue
        done.batches[topic.robot, topic.name] += 1
        done.samples[topic.robot, topic.name] += len(batch.times_us)
        yield item


def _checked(item: Item, namespace: str) -> tuple[Topic, Batch]:
    # The time of receipt is left out, because a batch may be years ahead of it.
    topic, batch = decode_item(plain({name: value for name, value in item.items() if name != RECEIVED_MS}))
    if topic.namespace != namespace:
        raise ContractError(f"the namespace must be {namespace}, got {topic.namespace}")
    return topic, batch


def write(table: TelemetryTable, items: Sequence[Mapping[str, Any]], units_per_s: int) -> None:
    """Write items at so many write units a second; raises `StationError` if DynamoDB rejects them."""
    began = time.monotonic()
    try:
        table.put(items)
    except TableError as error:
        raise StationError(f"{error}; do it again, or with fewer --units") from error
    spent_s = sum(map(_units, items)) / units_per_s
    time.sleep(max(0.0, began + spent_s - time.monotonic()))


def _units(item: Mapping[str, Any]) -> int:
    """About the write units of an item, which is nearly all samples."""
    return -(-len(str(item)) // _UNIT_BYTES)
