"""What robots recorded, by stream and range, and what the registry says of them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import suppress
from functools import cache
from itertools import islice
from typing import TYPE_CHECKING, Any, NamedTuple

from functions.shared import clients
from functions.shared.clients import variables
from iort_analysis.archive.hours import Stores
from iort_analysis.archive.stored import Stored
from iort_analysis.samples import batches
from iort_contract.archive import ArchiveTable
from iort_contract.catalog.derived import Vehicle, registered_vehicle
from iort_contract.catalog.environments import PlanEnvironment
from iort_contract.catalog.streams import OWN_STREAMS
from iort_contract.catalog.vesc import VESC_STREAM
from iort_contract.dynamodb import TelemetryTable, plain, quick, with_samples_between
from iort_contract.limits import ContractError
from iort_contract.messages.batch import decode_batch
from iort_contract.tables import ROBOT, STREAMS
from iort_contract.topics import RECORD, build_topic

if TYPE_CHECKING:
    from types_boto3_dynamodb import DynamoDBClient

# A stream with more fields is a scan or an image, from which nothing is mined.
MAX_FIELDS = 100
# A stream's fields are looked at so often in a range, nearer to each other where its recordings end sooner: a
# field may come later. So many broken batches in a row tell none.
_LOOKS, _TRIES = 4, 5
_LEAST_APART_US = 60_000_000


class Registered(NamedTuple):
    """What the registry says of a robot; nothing of one that is not registered.

    ``known`` are the numbers of its row, such as ``mass_kg``.
    """

    streams: Sequence[str]
    vehicle: Vehicle | None
    known: dict[str, float]


class Recordings:
    """Reads the tables of telemetry and of robots."""

    def __init__(self, client: DynamoDBClient, stores: Stores, *, robots: str, namespace: str) -> None:
        self._client, self._stores, self._robots, self._namespace = client, stores, robots, namespace

    def robots(self) -> list[str]:
        """The names of all registered robots."""
        return robots_of(self._client, self._robots)

    def registered(self, robot: str) -> Registered:
        """What is known of a robot."""
        answer = self._client.get_item(TableName=self._robots, Key={ROBOT: {"S": robot}}, ConsistentRead=True)
        row = plain(answer.get("Item", {}))
        known = {name: float(value) for name, value in row.items() if _is_number(value)}
        streams = sorted({VESC_STREAM, *row.get(STREAMS, ())} - OWN_STREAMS)
        return Registered(streams, registered_vehicle(known), known)

    def items(
        self,
        robot: str,
        stream: str,
        start_us: int,
        end_us: int,
        *,
        page_items: int | None = None,
        refused: batches.RefusedItems | None = None,
    ) -> Iterator[batches.Item]:
        """The stored items with samples from ``start_us`` to ``end_us`` (exclusive), in order of time.

        ``refused`` gets what cannot be read of the archive; what is no batch is among the items.
        """
        stored = Stored(self._stores, build_topic(RECORD, robot, stream, self._namespace), refused=refused)
        for items in stored.items(with_samples_between(start_us, end_us), (), page_items=page_items):
            yield from items

    def fields(self, robot: str, stream: str, start_us: int, end_us: int) -> list[str] | None:
        """The fields that a stream has at the beginning of a range or at some times later; None if it has no
        samples there that could be mined."""
        names: dict[str, None] | None = None
        # A range may begin years before the recordings, and end years after them.
        at_us, apart_us, looks = start_us, (end_us - start_us) // _LOOKS, 0
        seen_us = start_us
        while looks < _LOOKS and at_us < end_us:
            found = list(islice(self.items(robot, stream, at_us, end_us, page_items=_TRIES), _TRIES))
            if found:
                looks, seen_us = looks + 1, max(at_us, batches.start_us(found[0]))
            elif not looks or apart_us < _LEAST_APART_US:
                break
            else:
                apart_us //= _LOOKS
            at_us = seen_us + max(apart_us, 1)
            for item in found:
                with suppress(ContractError):
                    names = (names or {}) | dict.fromkeys(decode_batch(plain(item)).columns)
                    break
        return None if names is None or len(names) > MAX_FIELDS else list(names)


def robots_of(client: DynamoDBClient, table: str) -> list[str]:
    """The names of all registered robots."""
    pages = client.get_paginator("scan").paginate(
        TableName=table, ProjectionExpression="#robot", ExpressionAttributeNames={"#robot": ROBOT}
    )
    return sorted(str(item[ROBOT]["S"]) for page in pages for item in page["Items"])


def _is_number(value: Any) -> bool:
    return not isinstance(value, (bool, str, set, list, dict, bytes)) and value is not None


@cache
def deployed() -> Recordings:
    """The recordings of this function's deployment."""
    given = variables(PlanEnvironment)
    dynamodb = quick(clients.dynamodb())
    return Recordings(
        dynamodb,
        Stores(
            TelemetryTable(dynamodb, given.telemetry_table),
            ArchiveTable(dynamodb, given.archive_table),
            lambda: (clients.s3(), given.files_bucket),
        ),
        robots=given.robots_table,
        namespace=given.namespace,
    )
