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

from bench.errors import BenchError
from bench.load import stored_drive
from bench.message_sizes import item_bytes
from bench.meters import cpu
from bench.report import plots, thesis
from bench.report.result import NOT_MEASURED, Plot, Ratio, Section, Table
from bench.report.spread import ratio, spread
from bench.target import Say, Target
from iort_contract.catalog.vesc import VESC_STREAM
from iort_contract.tables import RECEIVED_MS, TOPIC
from iort_contract.topics import RECORD, build_topic
from iort_station import data
from iort_station.operations import delivery

POINTS = 14_368
ROBOT, HOUR_ROBOT = "bench-query", "bench-hour"
REPEATS = 3
HOUR_POINTS = 3600 * stored_drive.RATE_HZ
_CATCH_UP_S = 120.0
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


def run(target: Target, say: Say) -> Section:
    """Store the same drive in both layouts, then read it back in turns."""
    section = Section("query", "Query and scan (table 6.6)")
    robot, samples = target.name(ROBOT), stored_drive.simulated(POINTS)
    say(f"storing {POINTS:,} points in both layouts")
    stored_drive.store(target, robot, samples)
    _until_summarized(target, robot, POINTS, say)
    with _thesis_table(target, robot, samples) as table:
        topic = build_topic(RECORD, robot, VESC_STREAM, target.cloud.namespace)
        ways: dict[str, Callable[[], int]] = {
            THESIS_QUERY: lambda: _pages(table.query, KeyConditionExpression=Key(TOPIC).eq(topic)),
            OURS_QUERY: lambda: len(data.query(target.cloud, robot, VESC_STREAM)),
            THESIS_SCAN: lambda: _pages(table.scan, FilterExpression=Attr(TOPIC).eq(topic)),
            OURS_SCAN: lambda: len(data.query(target.cloud, robot, VESC_STREAM, scan=True)),
            LAMBDA_QUERY: lambda: len(data.query(target.cloud, robot, VESC_STREAM, on=data.LAMBDA)),
            LAMBDA_SCAN: lambda: len(data.query(target.cloud, robot, VESC_STREAM, on=data.LAMBDA, scan=True)),
        }
        found = {name: Way() for name in ways}
        stored_mb = (
            POINTS
            * item_bytes(
                {TOPIC: topic, "t": samples[-1][0], **_header(POINTS, samples[-1][0]), **samples[-1][1]}
            )
            / 1e6
        )
        section.notes.append(
            f"An item of the thesis' layout holds the ROS message with its header: {stored_mb:.2f} MB, "
            "where the thesis' were 4.95 MB."
        )
        for turn in range(REPEATS + 1):
            for name, read in ways.items():
                say(f"{name}, {turn} of {REPEATS}" if turn else f"{name}, to warm up")
                # A read of 50 ms runs several times a turn: one alone would depend on the machine.
                looks = sorted(
                    (_timed(target, read) for _ in range(_LOOKS.get(name, 1))),
                    key=lambda look: look.client_cpu_s,
                )
                if turn:
                    _add(found[name], looks[len(looks) // 2])
    for name, way in found.items():
        if way.read != POINTS:
            raise BenchError(f"{name}: {way.read} of {POINTS} points")
    _report(section, found)
    _hour(target, section, say)
    return section


def _hour(target: Target, section: Section, say: Say) -> None:
    robot = target.name(HOUR_ROBOT)
    say(f"storing an hour of one robot, {HOUR_POINTS:,} points")
    stored_drive.store(target, robot, stored_drive.simulated(HOUR_POINTS))
    _until_summarized(target, robot, HOUR_POINTS, say)
    way = Way()
    for turn in range(REPEATS + 1):
        say(f"an hour, {turn} of {REPEATS}" if turn else "an hour, to warm up")
        one = _timed(target, lambda: len(data.query(target.cloud, robot, VESC_STREAM)))
        if turn:
            _add(way, one)
    if way.read != HOUR_POINTS:
        raise BenchError(f"an hour: {way.read} of {HOUR_POINTS} points")
    section.tables.append(
        Table(f"An hour of one robot, {HOUR_POINTS:,} points", _COLUMNS, [_row(OURS_QUERY, way)])
    )
    section.raw["an hour"] = asdict(way)


def _until_summarized(target: Target, robot: str, points: int, say: Say) -> None:
    """Wait for Lambda 2, whose work would slow the reading."""
    deadline = time.monotonic() + _CATCH_UP_S
    while (done := delivery.samples_summarized(target.cloud, robot, VESC_STREAM)) < points:
        if time.monotonic() > deadline:
            return
        say(f"{done:,} of {points:,} points summarised")
        time.sleep(2)


def _report(section: Section, found: dict[str, Way]) -> None:
    section.tables.append(
        Table(
            f"{POINTS:,} points: median (range of {REPEATS} repeats, in turns)",
            _COLUMNS,
            [_row(name, way) for name, way in found.items()],
        )
    )
    faster = ratio(
        [[v] for v in found[THESIS_QUERY].client_cpu_s], [[v] for v in found[OURS_QUERY].client_cpu_s]
    )
    sooner = ratio([[v] for v in found[THESIS_QUERY].wall_s], [[v] for v in found[OURS_QUERY].wall_s])
    if faster is not None and sooner is not None:
        section.ratios.append(
            Ratio("query, client's processor: thesis' layout / ours", round(faster, 1), 20.0, at_least=True)
        )
        section.ratios.append(
            Ratio("query, wall: thesis' layout / ours", round(sooner, 1), None, at_least=True, tolerance=2)
        )
    in_lambda = ratio(
        [[v] for v in found[THESIS_QUERY].client_cpu_s], [[v] for v in found[LAMBDA_QUERY].client_cpu_s]
    )
    if in_lambda is not None:
        section.ratios.append(
            Ratio(
                "query in Lambda, client's processor: thesis' layout / ours",
                round(in_lambda, 1),
                None,
                at_least=True,
            )
        )
    title = f"{POINTS:,} points, client's processor"
    values = {name: median(way.client_cpu_s) for name, way in found.items()}
    section.plots.append(Plot("query", title, plots.bars(title, values, unit="s", log=True)))
    section.notes.append(
        "The thesis' layout is measured as its programs read it: boto3's Table, which makes a Decimal of "
        "every number. A scan reads the whole table, so it also pays for what other sections have stored."
    )
    section.raw = {name: asdict(way) for name, way in found.items()}


def _row(name: str, way: Way) -> list[str]:
    return [
        name,
        _text(spread([[v] for v in way.wall_s])),
        _text(spread([[v] for v in way.client_cpu_s])),
        f"{median(way.wall_s) - median(way.client_cpu_s):.3f} s",
        f"{median(way.server_cpu_s):.3f} s" if way.server_cpu_s else NOT_MEASURED,
        THESIS_S[name] if way.read == POINTS else NOT_MEASURED,
    ]


def _text(one: Any) -> str:
    return NOT_MEASURED if one is None else f"{one.p50:.3f} s ({one.low:.3f} to {one.high:.3f})"


class _Look(NamedTuple):
    """The number of points of one read, and its times."""

    points: int
    wall_s: float
    client_cpu_s: float
    server_cpu_s: float | None


def _timed(target: Target, read: Callable[[], int]) -> _Look:
    server = None if target.embedded is None else target.embedded.emulator.pid
    before = _server(server)
    cpu_s, wall_s = time.process_time(), time.perf_counter()
    count = read()
    wall_s, cpu_s = time.perf_counter() - wall_s, time.process_time() - cpu_s
    after = _server(server)
    spent = None if before is None or after is None else cpu.spent_ms(before, after) / 1000
    return _Look(count, wall_s, cpu_s, spent)


def _server(pid: int | None) -> dict[int, int] | None:
    """Return the processor time of the emulator and of its children, the functions' workers."""
    return None if pid is None else cpu.of_process(pid) | cpu.of_tree(pid)


def _add(way: Way, look: _Look) -> None:
    way.read = look.points
    way.wall_s.append(round(look.wall_s, 4))
    way.client_cpu_s.append(round(look.client_cpu_s, 4))
    if look.server_cpu_s is not None:
        way.server_cpu_s.append(round(look.server_cpu_s, 4))


def _pages(read: Callable[..., dict[str, Any]], **arguments: Any) -> int:
    """Read every page and keep the items, as the thesis' programs did."""
    items: list[dict[str, Any]] = []
    while True:
        page = read(**arguments)
        items += page["Items"]
        if "LastEvaluatedKey" not in page:
            return len(items)
        arguments["ExclusiveStartKey"] = page["LastEvaluatedKey"]


def _header(seq: int, t_us: int) -> dict[str, Any]:
    """Return the header of a ROS message and the time of receipt.

    With them an item is nearly as large as the thesis' items: 4.95 MB / 14,368.
    """
    return {
        "seq": seq,
        "secs": t_us // 1_000_000,
        "nsecs": t_us % 1_000_000 * 1000,
        "frame_id": "base_link",
        RECEIVED_MS: t_us // 1000,
    }


@contextmanager
def _thesis_table(target: Target, robot: str, samples: list[stored_drive.Sample]) -> Iterator[Any]:
    """Yield a temporary table with one item a sample, as the thesis' rule wrote it."""
    name = target.name(f"{target.cloud.namespace}-bench-thesis")
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
        TableName=name,
        KeySchema=[{"AttributeName": TOPIC, "KeyType": "HASH"}, {"AttributeName": "t", "KeyType": "RANGE"}],
        AttributeDefinitions=[
            {"AttributeName": TOPIC, "AttributeType": "S"},
            {"AttributeName": "t", "AttributeType": "N"},
        ],
        BillingMode="PAY_PER_REQUEST",
    )
    try:
        table.wait_until_exists()
        topic = build_topic(RECORD, robot, VESC_STREAM, cloud.namespace)
        with table.batch_writer() as batch:
            for seq, (t_us, sample) in enumerate(samples):
                numbers = {key: Decimal(repr(value)) for key, value in sample.items()}
                batch.put_item(Item={TOPIC: topic, "t": t_us, **_header(seq, t_us), **numbers})
        yield table
    finally:
        table.delete()
