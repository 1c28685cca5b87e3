"""Table 6.4: robot - broker, robot - broker - rule, robot - broker - Lambda, beside the physical limits.

Each path has a connection of its own, by the agent's own uplink and pings, and so has the floor: the
smallest MQTT client there can be, on the same broker at the same rate at the same time. On the embedded
cloud everything is measured again with the ping of the thesis added (`bench.sections.thesis_ping`).
"""

from __future__ import annotations

from itertools import product

from bench.floors.raw_mqtt import tcp_connect_s
from bench.meters.round_trips import RAW, RoundTrips
from bench.report import plots
from bench.report.result import NOT_MEASURED, Section
from bench.report.spread import ratio, rounded, text
from bench.sections import thesis_ping
from iort_agent.mqtt.rate_limiter import BYTES_PER_S
from iort_contract.catalog.questions import CALIBRATION
from iort_contract.topics import BROKER, LAMBDA, PING_PATHS, RULE
from local.figures import THESIS
from testkit.car import asking, round_trips_ms
from testkit.target import Say, Target

SIZES = {"0.5 KB": 512, "5 KB": 5 * 1024, "50 KB": 50 * 1024, "127 KB": 127 * 1024 - 200}
RATES_HZ = (1, 10, 50)
REPEATS = 3
# Within a robot's quota of an hour.
_QUESTIONS, _QUESTIONS_HZ = 40, 10
_LEAST, _LEAST_S = 12, 3.0
# Round trips in ms by way, a list a repeat.
Cell = dict[str, list[list[float]]]


def run(target: Target, say: Say) -> Section:
    """Measure every size at every rate that one connection may send."""
    section = Section("round_trips", "Round trips (table 6.4)")
    cells: dict[tuple[str, int], Cell] = {}
    bundles = {path: target.robot(f"bench-rtt-{path}") for path in PING_PATHS}
    floor = target.robot("bench-rtt-raw")
    with RoundTrips(bundles, floor, target.cloud.namespace) as lines:
        host, port = target.cloud.mqtt_endpoint, target.cloud.mqtt_port
        floors = {
            "TCP handshake (ping)": [tcp_connect_s(host, port) * 1000 for _ in range(30)],
            "TLS echo (PINGREQ)": [lines.raw.ping() * 1000 for _ in range(100)],
        }
        for repeat, (size, rate_hz) in product(range(REPEATS), product(SIZES, RATES_HZ)):
            if SIZES[size] * rate_hz > BYTES_PER_S:
                continue
            say(f"{size} at {rate_hz} Hz, {repeat + 1} of {REPEATS}")
            found = lines.measure(size=SIZES[size], rate_hz=rate_hz, lasts_s=seconds(rate_hz))
            cell = cells.setdefault((size, rate_hz), {name: [] for name in found})
            for name, values in found.items():
                cell[name].append(values)
    say(f"the question {CALIBRATION.name}")
    with asking(target.robot("bench-ask")) as ask:
        asked = round_trips_ms(ask, CALIBRATION.name, count=_QUESTIONS, rate_hz=_QUESTIONS_HZ)
    _report(section, cells, floors)
    _report_questions(section, asked, cells)
    section.ratio("pings that did not come back", lines.lost, 0, unit="pings")
    if target.embedded is not None:
        thesis_ping.report(section, thesis_ping.measure(target, bundles, floor, say))
    return section


def _report_questions(section: Section, asked: list[float], cells: dict[tuple[str, int], Cell]) -> None:
    pinged = cells[("0.5 KB", _QUESTIONS_HZ)][LAMBDA]
    section.table(
        "A question to the cloud, beside a ping of 0.5 KB through Lambda at the same rate",
        ["what", "round trip: median (p95, p99)"],
        [[f"the question `{CALIBRATION.name}`", text([asked])], ["ping through Lambda", text(pinged)]],
    )
    times = ratio([asked], pinged)
    section.ratio("round trip of a question / of a ping over lambda", times and round(times, 3), None)
    section.notes.append(
        f"The question {CALIBRATION.name} checks the deadline, counts in the robot's row and reads the "
        f"findings: {_QUESTIONS} of them, of {CALIBRATION.per_hour} that a robot may ask in an hour."
    )


def seconds(rate_hz: float) -> float:
    """How long a size is measured at a rate, once."""
    return max(_LEAST_S, _LEAST / rate_hz / 3)


def _report(section: Section, cells: dict[tuple[str, int], Cell], floors: dict[str, list[float]]) -> None:
    ways = (*PING_PATHS, RAW)
    rows = []
    for (size, rate_hz), cell in cells.items():
        against = ratio(cell[BROKER], cell[RAW])
        shown = NOT_MEASURED if against is None else f"{against:.2f}"
        rows.append([f"{size} at {rate_hz} Hz", *(text(cell[name]) for name in ways), shown])
    rows.append(["thesis, 2018", *(f"{THESIS[path]} ms" for path in PING_PATHS), NOT_MEASURED, NOT_MEASURED])
    section.table(
        "Round trips: median (p95, p99; range of the medians of the repeats)",
        ["payload", "broker", "rule republish", "Lambda", "floor: raw MQTT client", "broker / floor"],
        rows,
    )
    limits = [[name, text([values], digits=3)] for name, values in floors.items()]
    section.table("Physical limits to the same endpoint, same run", ["limit", "round trip"], limits)
    usual = cells[("0.5 KB", 10)]
    curves = {
        name if name == RAW else f"robot - {name}": [v for values in usual[name] for v in values]
        for name in ways
    }
    section.plot("round-trips", "Round trips, 0.5 KB at 10 Hz", plots.cdf({**curves, **floors}))
    small = [ratio(cell[BROKER], cell[RAW]) for (size, _), cell in cells.items() if size == "0.5 KB"]
    middle = sorted(value for value in small if value is not None)[len(small) // 2]
    section.ratio("broker round trip / raw MQTT client", round(middle, 3), 1.5)
    for path in (RULE, LAMBDA):
        times = ratio(usual[path], usual[BROKER])
        section.ratio(f"round trip over {path} / over broker", times and round(times, 3), None)
    section.notes.append(
        f"A connection may send {BYTES_PER_S // 1024} KB a second (AWS' quota), so the larger payloads are "
        "not measured at the higher rates. 127 KB is the largest message of the contract: AWS closes "
        "a connection that sends more than 128 KB."
    )
    section.raw = {
        "cells": {f"{size} at {rate} Hz": rounded(cell, 4) for (size, rate), cell in cells.items()},
        "floors": rounded({name: [values] for name, values in floors.items()}, 6),
    }
