"""Table 6.4: robot - broker, robot - broker - rule, robot - broker - Lambda, beside the physical limits.

Each path has a connection of its own, by the agent's own uplink and pings, and so has the floor: the
smallest MQTT client there can be, on the same broker at the same rate at the same time. On the embedded
cloud everything is measured again with the ping of the thesis added (`bench.sections.thesis_ping`).
"""

from __future__ import annotations

from dataclasses import asdict
from itertools import product
from typing import Any

from bench.floors.raw_mqtt import RawClient, tcp_connect_s
from bench.meters.round_trips import RAW, RoundTrips
from bench.report import plots
from bench.report.result import NOT_MEASURED, Plot, Ratio, Section, Table
from bench.report.spread import ratio, spread
from bench.sections import thesis_ping
from bench.target import Say, Target
from iort_agent.rate_limiter import BYTES_PER_S
from iort_contract.topics import BROKER, LAMBDA, PING_PATHS, RULE
from local.figures import THESIS

SIZES = {"0.5 KB": 512, "5 KB": 5 * 1024, "50 KB": 50 * 1024, "127 KB": 127 * 1024 - 200}
RATES_HZ = (1, 10, 50)
REPEATS = 3
_LEAST, _LEAST_S = 12, 3.0


def run(target: Target, say: Say) -> Section:
    """Measure every size at every rate that one connection may send."""
    section = Section("round_trips", "Round trips (table 6.4)")
    cells: dict[tuple[str, int], dict[str, list[list[float]]]] = {}
    bundles = {path: target.robot(f"bench-rtt-{path}") for path in PING_PATHS}
    floor = target.robot("bench-rtt-raw")
    with RoundTrips(bundles, floor, target.cloud.namespace) as lines:
        floors = _floors(target, lines.raw)
        for repeat, (size, rate_hz) in product(range(REPEATS), product(SIZES, RATES_HZ)):
            if SIZES[size] * rate_hz > BYTES_PER_S:
                continue
            say(f"{size} at {rate_hz} Hz, {repeat + 1} of {REPEATS}")
            found = lines.measure(size=SIZES[size], rate_hz=rate_hz, lasts_s=seconds(rate_hz))
            cell = cells.setdefault((size, rate_hz), {name: [] for name in found})
            for name, values in found.items():
                cell[name].append(values)
    _report(section, cells, floors)
    section.ratios.append(Ratio("pings that did not come back", lines.lost, 0, "pings"))
    if target.embedded is not None:
        thesis_ping.report(section, thesis_ping.measure(target, bundles, floor, say))
    return section


def seconds(rate_hz: float) -> float:
    """How long a size is measured at a rate, once."""
    return max(_LEAST_S, _LEAST / rate_hz / 3)


def _floors(target: Target, raw: RawClient) -> dict[str, list[float]]:
    host, port = target.cloud.mqtt_endpoint, target.cloud.mqtt_port
    return {
        "TCP handshake (ping)": [tcp_connect_s(host, port) * 1000 for _ in range(30)],
        "TLS echo (PINGREQ)": [raw.ping() * 1000 for _ in range(100)],
    }


def _report(
    section: Section,
    cells: dict[tuple[str, int], dict[str, list[list[float]]]],
    floors: dict[str, list[float]],
) -> None:
    rows = []
    for (size, rate_hz), cell in cells.items():
        shown = [spread(cell[name]) for name in (*PING_PATHS, RAW)]
        against = ratio(cell[BROKER], cell[RAW])
        rows.append(
            [
                f"{size} at {rate_hz} Hz",
                *(NOT_MEASURED if one is None else one.text("ms") for one in shown),
                NOT_MEASURED if against is None else f"{against:.2f}",
            ]
        )
    rows.append(["thesis, 2018", *(f"{THESIS[path]} ms" for path in PING_PATHS), NOT_MEASURED, NOT_MEASURED])
    section.tables.append(
        Table(
            "Round trips: median (p95, p99; range of the medians of the repeats)",
            ["payload", "broker", "rule republish", "Lambda", "floor: raw MQTT client", "broker / floor"],
            rows,
        )
    )
    shown_floors = {name: spread([values]) for name, values in floors.items()}
    section.tables.append(
        Table(
            "Physical limits to the same endpoint, same run",
            ["limit", "round trip"],
            [[name, one.text("ms", 3)] for name, one in shown_floors.items() if one is not None],
        )
    )
    usual = cells[("0.5 KB", 10)]
    curves = {name: [v for values in usual[name] for v in values] for name in (*PING_PATHS, RAW)}
    title = "Round trips, 0.5 KB at 10 Hz"
    named = {f"robot - {path}" if path != RAW else RAW: values for path, values in curves.items()}
    section.plots.append(Plot("round-trips", title, plots.cdf(title, {**named, **floors})))
    of_small = [ratio(cell[BROKER], cell[RAW]) for key, cell in cells.items() if key[0] == "0.5 KB"]
    found = sorted(value for value in of_small if value is not None)
    section.ratios.append(Ratio("broker round trip / raw MQTT client", round(found[len(found) // 2], 3), 1.5))
    for path in (RULE, LAMBDA):
        value = ratio(usual[path], usual[BROKER])
        if value is not None:
            section.ratios.append(Ratio(f"round trip over {path} / over broker", round(value, 3), None))
    section.notes.append(
        f"A connection may send {BYTES_PER_S // 1024} KB a second (AWS' quota), so the larger payloads are "
        "not measured at the higher rates. 127 KB is the largest message of the contract: AWS closes "
        "a connection that sends more than 128 KB."
    )
    section.raw = {
        "cells": {f"{size} at {rate} Hz": _rounded(cell) for (size, rate), cell in cells.items()},
        "floors": {name: asdict(one) for name, one in shown_floors.items() if one is not None},
    }


def _rounded(cell: dict[str, list[list[float]]]) -> dict[str, Any]:
    summary = {name: spread(repeats) for name, repeats in cell.items()}
    return {name: {k: round(v, 4) for k, v in asdict(one).items()} for name, one in summary.items() if one}
