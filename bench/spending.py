"""Estimates the cost of `make bench TARGET=aws` at list prices, from the work of each section."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import product
from math import ceil

from bench.sections import dashboard, outage, query, round_trips, utilisation, viewing
from iort_agent.mqtt.rate_limiter import BYTES_PER_S
from iort_contract.topics import PING_PATHS
from iort_station.cloud import Cloud
from iort_station.cost import model
from iort_station.cost.model import LineItem
from iort_station.cost.usage import Usage

# AWS' units: a message and an action are metered by 5 KB, writes by 1 KB, reads by 4 KB and by half where
# they need not be consistent.
_METER, _WRITE, _READ = 5 * 1024, 1024, 2 * 4096
# Write units of a compressed batch of 50 samples with its keys, and of a second of its summary.
_BATCH_WRITES, _SUMMARY_WRITES = 2, 3
_BILLED_S = 0.02
_MINUTES_CONNECTED = 30
_WAKE_S = 5


def estimate(cloud: Cloud, sections: Sequence[str]) -> dict[str, float]:
    """Return a generous estimate in dollars for each section, AWS alone, at the cost model's prices."""
    counted: dict[str, Callable[[], list[LineItem]]] = {
        "round_trips": _round_trips,
        "dashboard": lambda: _driven(dashboard.SECONDS * 2),
        "utilisation": _utilisation,
        "query": lambda: _query(cloud),
        "command": lambda: _items(write=60 * (_BATCH_WRITES + _SUMMARY_WRITES), read=60 * _BATCH_WRITES),
        # A metric of its own, for the hour that AWS bills.
        "abilities": lambda: [*_items(metric=1 / 730, message=500, write=500), *_invoked(100, 512)],
        # Both ways, each with its wakes; a wake waits for the car to be idle.
        "viewing": lambda: _driven(viewing.IDLE_S + 2 * (viewing.WATCHED_S + viewing.WAKES * _WAKE_S)),
        "outage": lambda: _driven(outage.BEFORE_S + outage.CUT_S + outage.AFTER_S),
    }
    return {key: model.total(counted[key]()) for key in sections if key in counted}


def _round_trips() -> list[LineItem]:
    messages, rules, answers = 0, 0, 0
    for size, rate_hz in product(round_trips.SIZES.values(), round_trips.RATES_HZ):
        if size * rate_hz <= BYTES_PER_S:
            pings = round_trips.REPEATS * ceil(rate_hz * round_trips.seconds(rate_hz))
            metered = pings * ceil(size / _METER)
            # There and back, of each path and of the floor.
            messages += 2 * metered * (len(PING_PATHS) + 1)
            rules += 2 * metered
            answers += pings
    connected = 4 * _MINUTES_CONNECTED
    return [
        *_items(message=messages, rule=rules, action=rules, connection=connected),
        *_invoked(answers, 256),
    ]


def _driven(seconds: float) -> list[LineItem]:
    items = model.bill(Usage(ping_hz=1, agent_every_s=1))
    return [item._replace(units=item.units * seconds / 3600) for item in items]


def _utilisation() -> list[LineItem]:
    calls = utilisation.CALLS * utilisation.ROUNDS
    sized = [item for size in utilisation.SIZES_MB for item in _invoked(calls, size)]
    written = utilisation.BATCHES * (_BATCH_WRITES + _SUMMARY_WRITES)
    # Lambda 2 and its floor: events of one batch, and a tenth as many of a backlog.
    written += 2 * calls * _SUMMARY_WRITES * (1 + utilisation.BATCHES // 10)
    return [*_invoked(calls * 7, 512), *sized, *_items(write=written)]


def _query(cloud: Cloud) -> list[LineItem]:
    batches = ceil(query.POINTS / 50) + query.HOUR_POINTS // 50
    reads = query.REPEATS + 1
    stored = batches * _BATCH_WRITES * _WRITE
    # Two ways scan the whole table, whatever else is in it, and the thesis' way twice its own.
    scanned = 2 * (_telemetry_bytes(cloud) + stored) + 2 * query.POINTS * 512 + 3 * stored
    written = query.POINTS + batches * (_BATCH_WRITES + _SUMMARY_WRITES)
    return [*_items(write=written, read=ceil(reads * scanned / _READ)), *_invoked(batches + 2 * reads, 512)]


def _invoked(calls: int, memory_mb: int) -> list[LineItem]:
    return _items(invocation=calls, compute_x86=calls * memory_mb / 1024 * _BILLED_S * 5)


def _items(**units: float) -> list[LineItem]:
    return [LineItem("", price, count) for price, count in units.items()]


def _telemetry_bytes(cloud: Cloud) -> int:
    """Return the size of the table; AWS updates it every six hours."""
    table = cloud.output("storage", "TelemetryTable")
    described = cloud.client("dynamodb").describe_table(TableName=table)["Table"]
    return int(described.get("TableSizeBytes", 0))
