"""The adapter to DynamoDB: reads batches from the telemetry table, writes seconds to the summary table."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Iterator, Mapping
from contextlib import suppress
from itertools import count
from typing import Any

from botocore.exceptions import BotoCoreError, ClientError

from functions.shared.archive import Marks
from iort_contract.catalog.derived import Vehicle
from iort_contract.codec import Statistics
from iort_contract.dynamodb import SummaryTable, TelemetryTable, plain, starting_between
from iort_contract.limits import MAX_FIELD_CHARACTERS, ContractError
from iort_contract.messages.batch import BatchId, batch_id
from iort_contract.tables import BATCH, OMITTED, ROBOT, SECOND, STREAMS, TOPIC, VEHICLE_CACHE_S

_log = logging.getLogger(__name__)
# Page size, once many batches are wanted.
_MANY = 100
# How many streams a robot's row names, of which each write costs by its size, and how many an environment
# knows to be there.
MAX_STREAMS, _NOTED = 200, 50_000
# "Limits", items: 400 KB including the names; a margin is left for the size of numbers.
_MAX_ITEM_BYTES = 380 * 1024
# The longest text of a float; its stored number is shorter.
_MAX_NUMBER_BYTES = 25
# So many attributes of numbers alone always fit: a name with a statistic's suffix, and a list of four.
_FIT_WITHOUT_TEXT = _MAX_ITEM_BYTES // (MAX_FIELD_CHARACTERS + 8 + 4 * _MAX_NUMBER_BYTES)
# The range of a DynamoDB number, "Supported data types": 38 digits, 1e-130 to 9.99e125.
_LARGEST, _SMALLEST = 9.99e125, 1e-130


def attribute(value: Statistics) -> dict[str, Any]:
    """A value, or a list of values, as a DynamoDB attribute.

    A number too small becomes 0, one too large becomes text.
    """
    if isinstance(value, list):
        # Nearly all values of a second are here.
        return {
            "L": [
                {"N": repr(one)}
                if type(one) is int or (type(one) is float and _SMALLEST <= abs(one) <= _LARGEST)
                else attribute(one)
                for one in value
            ]
        }
    if isinstance(value, float):
        if _SMALLEST <= abs(value) <= _LARGEST:
            return {"N": repr(value)}
        return {"N": "0"} if abs(value) < _SMALLEST else {"S": repr(value)}
    if isinstance(value, bool):
        return {"BOOL": value}
    if isinstance(value, int):
        return {"N": repr(value)}
    return {"NULL": True} if value is None else {"S": value}


class Tables:
    """The tables of summaries; ``client`` is a boto3 DynamoDB client or a fake of it."""

    def __init__(self, client: Any, *, telemetry: str, summary: str, robots: str, archive: str = "") -> None:
        self._client = client
        # Without an archive, nothing is marked for it.
        self.marks = Marks(client, archive) if archive else None
        self.telemetry, self._summary = TelemetryTable(client, telemetry), SummaryTable(client, summary)
        self._robots = robots
        self._vehicles: dict[str, tuple[float, Vehicle | None]] = {}
        self._noted: set[tuple[str, str]] = set()

    def batches_from(self, topic: str, first_us: int, *, at_once: int) -> Iterator[dict[str, Any]]:
        """A topic's stored batches from a start time on, in order of time. The first page has ``at_once``
        batches, and each one after it four times as many: callers rarely want a whole drive. While summaries
        are late, what was stored since comes after what they want."""
        keys, after = starting_between(first_us, None), None
        for pages in count():
            size = min(at_once << 2 * pages, max(at_once, _MANY))
            page = next(self.telemetry.pages(topic, keys, page_items=size, after=after))
            yield from map(plain, page.items)
            if (after := page.after) is None:
                return

    def before(self, topic: str, t_us: int) -> Iterator[dict[str, Any]]:
        """A topic's stored batches before a time, the nearest first. Each is read on demand, since the first
        one is nearly always enough."""
        keys = starting_between(None, t_us - 1)
        for page in self.telemetry.pages(topic, keys, page_items=1, newest_first=True):
            yield from map(plain, page.items)

    def numbers(self, topic: str, first_us: int, last_us: int) -> Iterator[BatchId]:
        """The ids of a topic's batches between two times, in order of time, without their samples."""
        keys = starting_between(first_us, last_us)
        for page in self.telemetry.pages(topic, keys, attributes=(BATCH,), page_items=_MANY):
            for item in page.items:
                with suppress(ContractError):
                    yield batch_id(item[BATCH]["S"])

    def vehicle(self, robot: str) -> Vehicle | None:
        """The robot's parameters, cached for `VEHICLE_CACHE_S`; None if not registered."""
        now = time.monotonic()
        cached = self._vehicles.get(robot)
        if cached is None or now - cached[0] > VEHICLE_CACHE_S:
            answer = self._client.get_item(
                TableName=self._robots, Key={ROBOT: {"S": robot}}, ConsistentRead=True
            )
            cached = self._vehicles[robot] = (now, _vehicle(plain(answer.get("Item", {}))))
        return cached[1]

    def note_stream(self, robot: str, stream: str) -> None:
        """Keep in the robot's row that it has the stream, once an environment. A robot that is not
        registered has no row, and gets none; one that names ever new streams has `MAX_STREAMS` of them."""
        if (robot, stream) in self._noted:
            return
        try:
            self._client.update_item(
                TableName=self._robots,
                Key={ROBOT: {"S": robot}},
                UpdateExpression="ADD #streams :stream",
                ConditionExpression=(
                    "attribute_exists(#robot) AND (attribute_not_exists(#streams) OR size(#streams) < :most)"
                ),
                ExpressionAttributeNames={"#streams": STREAMS, "#robot": ROBOT},
                ExpressionAttributeValues={":stream": {"SS": [stream]}, ":most": {"N": str(MAX_STREAMS)}},
            )
        except (BotoCoreError, ClientError) as error:
            # A failure is harmless: only the list of streams uses it, and the batches wait for nothing.
            _log.info("the stream %s of %s is not noted: %s", stream, robot, error)
        if len(self._noted) >= _NOTED:
            self._noted.clear()
        self._noted.add((robot, stream))

    def forget_vehicles(self) -> None:
        """Clear the cache of robots' parameters."""
        self._vehicles.clear()

    def put_seconds(self, seconds: Mapping[tuple[str, int], Mapping[str, Statistics]]) -> None:
        """Write the summaries, keyed by topic and second; raises `TableError` if some stay unwritten."""
        self._summary.put(self._second_item(*key, summary) for key, summary in seconds.items())

    def _second_item(self, topic: str, second: int, summary: Mapping[str, Statistics]) -> dict[str, Any]:
        item = fitting({name: attribute(value) for name, value in summary.items()})
        return {**item, TOPIC: {"S": topic}, SECOND: {"N": str(second)}}


def fitting(item: dict[str, Any]) -> dict[str, Any]:
    """The item without its largest attributes, so that it fits in DynamoDB's 400 KB.

    A stream may have 512 fields of texts of 4096 characters, and the summary keeps the last of each; the
    samples themselves are in the telemetry table.
    """
    if len(item) <= _FIT_WITHOUT_TEXT and not any("S" in value for value in item.values()):
        return item
    sizes = list(map(_size, item, item.values()))
    total, dropped = sum(sizes), set()
    if total <= _MAX_ITEM_BYTES:
        return item
    for size, name in sorted(zip(sizes, item, strict=True), reverse=True):
        if total <= _MAX_ITEM_BYTES:
            break
        dropped.add(name)
        total -= size
    _log.warning("a summary of %d attributes is too large: dropped %d", len(item), len(dropped))
    kept = {name: value for name, value in item.items() if name not in dropped}
    return {**kept, OMITTED: {"N": str(len(dropped))}}


def _size(name: str, value: Mapping[str, Any]) -> int:
    """An upper bound of DynamoDB's count: names and texts in UTF-8, numbers by their digits."""
    ((kind, content),) = value.items()
    if kind == "S":
        return len(name.encode()) + len(content.encode("utf-8", "surrogatepass")) + 3
    return len(name.encode()) + 3 + _MAX_NUMBER_BYTES * (len(content) if kind == "L" else 1)


def _vehicle(row: Mapping[str, Any]) -> Vehicle | None:
    """The vehicle in a row of the registry; a wrong row must not stop its robot's summaries."""
    if "speed_to_erpm_gain" not in row:
        return None
    try:
        gain, offset = float(row["speed_to_erpm_gain"]), float(row.get("speed_to_erpm_offset", 0))
    except (TypeError, ValueError):
        gain = offset = math.nan
    if not gain or not math.isfinite(gain) or not math.isfinite(offset):
        _log.warning("vehicle parameters of %s must be numbers, and the gain not 0", row.get(ROBOT))
        return None
    return Vehicle(gain, offset)
