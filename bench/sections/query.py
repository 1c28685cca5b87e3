"""Table 6.6: 14,368 points by query and by scan, on the operator's machine and in Lambda.

The same run reads the thesis' layout, one item a sample, through boto3's Table, and an hour of one robot.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from decimal import Decimal
from statistics import median
from typing import Any

import boto3
from boto3.dynamodb.conditions import Attr, Key

from bench import thesis
from bench.load import stored_drive
from bench.report import NOT_MEASURED, Section, ratio
from bench.sections import Declared
from iort_contract.catalog.vesc import VESC_STREAM
from iort_contract.tables import RECEIVED_MS, TOPIC
from iort_contract.topics import RECORD, build_topic
from iort_station import data
from testkit.car import RATE_HZ
from testkit.target import Say, Target
from testkit.waiting import InstrumentError

POINTS = 14_368
HOUR_POINTS = 3600 * RATE_HZ
REPEATS = 3
THESIS_QUERY, THESIS_SCAN = "thesis' layout, query through Table", "thesis' layout, scan through Table"
OURS_QUERY, OURS_SCAN = "iort, query on premises", "iort, scan on premises"
LAMBDA_QUERY, LAMBDA_SCAN = "iort, query in Lambda", "iort, scan in Lambda"
THESIS_S = {
    THESIS_QUERY: thesis.QUERY_ON_PREMISES,
    OURS_QUERY: thesis.QUERY_ON_PREMISES,
    THESIS_SCAN: thesis.SCAN_ON_PREMISES,
    OURS_SCAN: thesis.SCAN_ON_PREMISES,
    LAMBDA_QUERY: thesis.QUERY_IN_LAMBDA,
    LAMBDA_SCAN: thesis.SCAN_IN_LAMBDA,
}
# A read of 50 ms runs several times a turn: one alone would depend on the machine.
_READS = {OURS_QUERY: 5, OURS_SCAN: 5}
_COLUMNS = ["way", "wall", "client's processor", "thesis, 2018"]


@dataclass
class Way:
    """One way to read the points, in seconds for each repeat."""

    wall_s: list[float] = field(default_factory=list)
    client_cpu_s: list[float] = field(default_factory=list)

    def row(self, name: str) -> list[str]:
        """The medians, and the ranges of the repeats."""
        times = (
            f"{median(values):.3f} s ({min(values):.3f} to {max(values):.3f})"
            for values in (self.wall_s, self.client_cpu_s)
        )
        return [name, *times, THESIS_S.get(name, NOT_MEASURED)]


def run(target: Target, say: Say) -> Section:
    """Store the same drive in both layouts, then read it back in turns."""
    robot, samples = target.name("bench-query"), stored_drive.simulated(POINTS)
    topic = build_topic(RECORD, robot, VESC_STREAM, target.cloud.namespace)
    say(f"storing {POINTS:,} points in both layouts")
    stored_drive.store(target, robot, samples)

    def ours(name: str, **how: Any) -> Callable[[], int]:
        return lambda: len(data.query(target.cloud, name, VESC_STREAM, **how))

    with _thesis_table(target, _thesis_items(topic, samples)) as table:
        ways = {
            THESIS_QUERY: lambda: pages(table.query, KeyConditionExpression=Key(TOPIC).eq(topic)),
            OURS_QUERY: ours(robot),
            THESIS_SCAN: lambda: pages(table.scan, FilterExpression=Attr(TOPIC).eq(topic)),
            OURS_SCAN: ours(robot, scan=True),
            LAMBDA_QUERY: ours(robot, on=data.LAMBDA),
            LAMBDA_SCAN: ours(robot, on=data.LAMBDA, scan=True),
        }
        section = report(_read(ways, POINTS, say))
    robot = target.name("bench-hour")
    say(f"storing an hour of one robot, {HOUR_POINTS:,} points")
    stored_drive.store(target, robot, stored_drive.simulated(HOUR_POINTS))
    hour = _read({"an hour": ours(robot)}, HOUR_POINTS, say)["an hour"]
    section.table(f"An hour of one robot, {HOUR_POINTS:,} points", _COLUMNS, [hour.row("iort, query")])
    section.raw["an hour"] = asdict(hour)
    return section


def report(ways: dict[str, Way]) -> Section:
    """Make the section of all ways."""
    section = Section("query", "Query and scan (table 6.6)")
    title = f"{POINTS:,} points: median (range of {REPEATS} repeats, in turns)"
    section.table(title, _COLUMNS, [way.row(name) for name, way in ways.items()])
    for name, of, way, target, tolerance in (
        ("query, client's processor", "client_cpu_s", OURS_QUERY, 30.0, 1.5),
        ("query, wall", "wall_s", OURS_QUERY, None, 2.0),
        ("query in Lambda, client's processor", "client_cpu_s", LAMBDA_QUERY, None, 1.5),
    ):
        theirs, ours = ([[value] for value in getattr(ways[each], of)] for each in (THESIS_QUERY, way))
        whole = f"{name}: thesis' layout / ours"
        section.ratio(whole, ratio(theirs, ours), target, at_least=True, tolerance=tolerance)
    section.notes.append(
        "The thesis' layout is measured as its programs read it: boto3's Table, which makes a Decimal of "
        "every number. A scan reads the whole table, so it also pays for what other sections have stored."
    )
    section.raw = {name: asdict(way) for name, way in ways.items()}
    return section


def _read(ways: dict[str, Callable[[], int]], points: int, say: Say) -> dict[str, Way]:
    """Read in turns, once to warm up. Raises `InstrumentError` if a way does not read all points."""
    measured = {name: Way() for name in ways}
    for turn in range(REPEATS + 1):
        for name, read in ways.items():
            say(f"{name}, {turn} of {REPEATS}" if turn else f"{name}, to warm up")
            reads = sorted(_timed(read, name, points) for _ in range(_READS.get(name, 1)))
            cpu_s, wall_s = reads[len(reads) // 2]
            if turn:
                measured[name].client_cpu_s.append(cpu_s)
                measured[name].wall_s.append(wall_s)
    return measured


def _timed(read: Callable[[], int], name: str, points: int) -> tuple[float, float]:
    cpu_s, wall_s = time.process_time(), time.perf_counter()
    count = read()
    if count != points:
        raise InstrumentError(f"{name}: {count} of {points} points")
    return time.process_time() - cpu_s, time.perf_counter() - wall_s


def pages(read: Callable[..., dict[str, Any]], **arguments: Any) -> int:
    """Read every page and keep the items, as the thesis' programs did."""
    items: list[dict[str, Any]] = []
    while True:
        page = read(**arguments)
        items += page["Items"]
        if "LastEvaluatedKey" not in page:
            return len(items)
        arguments["ExclusiveStartKey"] = page["LastEvaluatedKey"]


def _thesis_items(topic: str, samples: list[stored_drive.Sample]) -> Iterator[dict[str, Any]]:
    """One item a sample, as the thesis' rule wrote it: with the ROS header and the time of receipt.

    With them an item is nearly as large as the thesis' items: 4.95 MB / 14,368.
    """
    for seq, (t_us, sample) in enumerate(samples):
        times = {"t": t_us, "secs": t_us // 1_000_000, "nsecs": t_us % 1_000_000 * 1000}
        header = {"seq": seq, **times, "frame_id": "base_link", RECEIVED_MS: t_us // 1000}
        item: dict[str, Any] = {TOPIC: topic, **header, **sample}
        yield {key: Decimal(repr(v)) if isinstance(v, float) else v for key, v in item.items()}


@contextmanager
def _thesis_table(target: Target, items: Iterator[dict[str, Any]]) -> Iterator[Any]:
    """Yield a temporary table with the items."""
    cloud = target.cloud
    resource = boto3.resource(
        "dynamodb",
        region_name=cloud.region,
        endpoint_url=cloud.endpoint_url,
        verify=cloud.ca_bundle,
        aws_access_key_id=cloud.access_key_id,
        aws_secret_access_key=cloud.secret_access_key,
    )
    table = resource.create_table(
        TableName=target.name(f"{cloud.namespace}-bench-thesis"),
        KeySchema=[{"AttributeName": TOPIC, "KeyType": "HASH"}, {"AttributeName": "t", "KeyType": "RANGE"}],
        AttributeDefinitions=[
            {"AttributeName": TOPIC, "AttributeType": "S"},
            {"AttributeName": "t", "AttributeType": "N"},
        ],
        BillingMode="PAY_PER_REQUEST",
    )
    try:
        table.wait_until_exists()
        with table.batch_writer() as batch:
            for item in items:
                batch.put_item(Item=item)
        yield table
    finally:
        table.delete()


SECTION = Declared("query and scan, beside the thesis' layout", run, dollars=0.05)
