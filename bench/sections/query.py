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
from typing import Any, NamedTuple

import boto3
from boto3.dynamodb.conditions import Attr, Key

from bench import plots, thesis
from bench.load import stored_drive
from bench.load.message_sizes import item_bytes
from bench.report import NOT_MEASURED, Section, ratio
from bench.sections import Declared
from iort_contract.catalog.vesc import VESC_STREAM
from iort_contract.tables import RECEIVED_MS, TOPIC
from iort_contract.topics import RECORD, build_topic
from iort_station import data
from testkit import machine
from testkit.car import RATE_HZ
from testkit.target import Say, Target
from testkit.waiting import InstrumentError

POINTS = 14_368
ROBOT, HOUR_ROBOT = "bench-query", "bench-hour"
REPEATS = 3
HOUR_POINTS = 3600 * RATE_HZ
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
_LOOKS = {OURS_QUERY: 5, OURS_SCAN: 5}
_COLUMNS = [
    "way",
    "wall",
    "client's processor",
    "waiting for the server",
    "server's processor",
    "thesis, 2018",
]


@dataclass
class Way:
    """One way to read the points, in seconds for each repeat; ``server_cpu_s`` needs the embedded cloud."""

    wall_s: list[float] = field(default_factory=list)
    client_cpu_s: list[float] = field(default_factory=list)
    server_cpu_s: list[float] = field(default_factory=list)
    read: int = 0

    def row(self, name: str) -> list[str]:
        waiting = median(self.wall_s) - median(self.client_cpu_s)
        server = f"{median(self.server_cpu_s):.3f} s" if self.server_cpu_s else NOT_MEASURED
        theirs = THESIS_S[name] if self.read == POINTS else NOT_MEASURED
        return [name, _range(self.wall_s), _range(self.client_cpu_s), f"{waiting:.3f} s", server, theirs]


def run(target: Target, say: Say) -> Section:
    """Store the same drive in both layouts, then read it back in turns."""
    section = Section("query", "Query and scan (table 6.6)")
    robot, samples = target.name(ROBOT), stored_drive.simulated(POINTS)
    topic = build_topic(RECORD, robot, VESC_STREAM, target.cloud.namespace)
    items = _thesis_items(topic, samples)
    say(f"storing {POINTS:,} points in both layouts")
    stored_drive.store(target, robot, samples)

    def ours(**how: Any) -> Callable[[], int]:
        return lambda: len(data.query(target.cloud, robot, VESC_STREAM, **how))

    with _thesis_table(target, items) as table:
        found = _read(
            target,
            {
                THESIS_QUERY: lambda: pages(table.query, KeyConditionExpression=Key(TOPIC).eq(topic)),
                OURS_QUERY: ours(),
                THESIS_SCAN: lambda: pages(table.scan, FilterExpression=Attr(TOPIC).eq(topic)),
                OURS_SCAN: ours(scan=True),
                LAMBDA_QUERY: ours(on=data.LAMBDA),
                LAMBDA_SCAN: ours(on=data.LAMBDA, scan=True),
            },
            POINTS,
            say,
        )
    section.notes.append(
        f"An item of the thesis' layout holds the ROS message with its header: "
        f"{POINTS * item_bytes(items[-1]) / 1e6:.2f} MB, where the thesis' were 4.95 MB."
    )
    report(section, found)
    robot = target.name(HOUR_ROBOT)
    say(f"storing an hour of one robot, {HOUR_POINTS:,} points")
    stored_drive.store(target, robot, stored_drive.simulated(HOUR_POINTS))
    hour = _read(target, {"an hour": ours()}, HOUR_POINTS, say)["an hour"]
    section.table(f"An hour of one robot, {HOUR_POINTS:,} points", _COLUMNS, [hour.row(OURS_QUERY)])
    section.raw["an hour"] = asdict(hour)
    return section


def report(section: Section, found: dict[str, Way]) -> None:
    """Add the table, the picture and the ratios."""
    title = f"{POINTS:,} points: median (range of {REPEATS} repeats, in turns)"
    section.table(title, _COLUMNS, [way.row(name) for name, way in found.items()])
    for name, of, way, target, tolerance in (
        ("query, client's processor", "client_cpu_s", OURS_QUERY, 30.0, 1.5),
        ("query, wall", "wall_s", OURS_QUERY, None, 2.0),
        ("query in Lambda, client's processor", "client_cpu_s", LAMBDA_QUERY, None, 1.5),
    ):
        theirs, ours = ([[value] for value in getattr(found[each], of)] for each in (THESIS_QUERY, way))
        times = ratio(theirs, ours)
        settings = {"at_least": True, "tolerance": tolerance}
        section.ratio(f"{name}: thesis' layout / ours", times and round(times, 1), target, **settings)
    values = {name: median(way.client_cpu_s) for name, way in found.items()}
    section.plot("query", f"{POINTS:,} points, client's processor", plots.bars(values, unit="s", log=True))
    section.notes.append(
        "The thesis' layout is measured as its programs read it: boto3's Table, which makes a Decimal of "
        "every number. A scan reads the whole table, so it also pays for what other sections have stored."
    )
    section.raw = {name: asdict(way) for name, way in found.items()}


def _range(values: list[float]) -> str:
    return f"{median(values):.3f} s ({min(values):.3f} to {max(values):.3f})"


def _read(target: Target, ways: dict[str, Callable[[], int]], points: int, say: Say) -> dict[str, Way]:
    """Read in turns, once to warm up. Raises `InstrumentError` if a way does not read all points."""
    found = {name: Way() for name in ways}
    for turn in range(REPEATS + 1):
        for name, read in ways.items():
            say(f"{name}, {turn} of {REPEATS}" if turn else f"{name}, to warm up")
            looks = [_timed(target, read) for _ in range(_LOOKS.get(name, 1))]
            look = sorted(looks, key=lambda look: look.client_cpu_s)[len(looks) // 2]
            way = found[name]
            way.read = look.points
            if turn:
                way.wall_s.append(round(look.wall_s, 4))
                way.client_cpu_s.append(round(look.client_cpu_s, 4))
                way.server_cpu_s += [] if look.server_cpu_s is None else [round(look.server_cpu_s, 4)]
    for name, way in found.items():
        if way.read != points:
            raise InstrumentError(f"{name}: {way.read} of {points} points")
    return found


class _Look(NamedTuple):
    """The number of points of one read, and its times."""

    points: int
    wall_s: float
    client_cpu_s: float
    server_cpu_s: float | None


def _timed(target: Target, read: Callable[[], int]) -> _Look:
    before = _server_ns(target)
    cpu_s, wall_s = time.process_time(), time.perf_counter()
    count = read()
    wall_s, cpu_s = time.perf_counter() - wall_s, time.process_time() - cpu_s
    server_s = machine.spent_ms(before, _server_ns(target)) / 1000 if before else None
    return _Look(count, wall_s, cpu_s, server_s)


def _server_ns(target: Target) -> dict[int, int]:
    """Return the processor time of the emulator and of the functions' workers; empty on AWS."""
    if target.embedded is None:
        return {}
    pid = target.embedded.emulator.pid
    return machine.threads_ns([pid, *machine.descendants(pid)])


def pages(read: Callable[..., dict[str, Any]], **arguments: Any) -> int:
    """Read every page and keep the items, as the thesis' programs did."""
    items: list[dict[str, Any]] = []
    while True:
        page = read(**arguments)
        items += page["Items"]
        if "LastEvaluatedKey" not in page:
            return len(items)
        arguments["ExclusiveStartKey"] = page["LastEvaluatedKey"]


def _thesis_items(topic: str, samples: list[stored_drive.Sample]) -> list[dict[str, Any]]:
    """One item a sample, as the thesis' rule wrote it: with the ROS header and the time of receipt.

    With them an item is nearly as large as the thesis' items: 4.95 MB / 14,368.
    """
    return [
        {
            TOPIC: topic,
            "t": t_us,
            "seq": seq,
            "secs": t_us // 1_000_000,
            "nsecs": t_us % 1_000_000 * 1000,
            "frame_id": "base_link",
            RECEIVED_MS: t_us // 1000,
            **sample,
        }
        for seq, (t_us, sample) in enumerate(samples)
    ]


@contextmanager
def _thesis_table(target: Target, items: list[dict[str, Any]]) -> Iterator[Any]:
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
                floats = {key: Decimal(repr(v)) for key, v in item.items() if isinstance(v, float)}
                batch.put_item(Item={**item, **floats})
        yield table
    finally:
        table.delete()


SECTION = Declared("query and scan, beside the thesis' layout", run)
