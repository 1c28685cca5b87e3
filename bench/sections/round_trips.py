"""Table 6.4: robot - broker, robot - broker - rule, robot - broker - Lambda, beside the physical limits.

Each path has a connection of its own, by the agent's own uplink and pings, and so has the floor: the
smallest MQTT client there can be, on the same broker at the same rate at the same time.
"""

from __future__ import annotations

import threading
import time
from contextlib import ExitStack
from dataclasses import asdict
from itertools import product
from typing import Any

from typing_extensions import Self

from bench import plots
from bench.errors import BenchError
from bench.raw_mqtt import RawClient, tcp_connect_s
from bench.result import NOT_MEASURED, Plot, Ratio, Section, Table
from bench.spread import ratio, spread
from bench.target import Say, Target
from contract import BROKER, LAMBDA, PING, PING_PATHS, PONG, RTT_FIELDS, RULE, Value, build_topic, encode_ping
from device.allowance import BYTES_PER_S, Allowance
from device.clock import SystemClock
from device.config import load_config
from device.dispatch import Dispatcher
from device.iotcore import IotCore
from device.pings import Pings
from local.figures import THESIS
from station.robots import Bundle

SIZES = {"0.5 KB": 512, "5 KB": 5 * 1024, "50 KB": 50 * 1024, "127 KB": 127 * 1024 - 200}
RATES_HZ = (1, 10, 50)
REPEATS = 3
RAW = "raw client"
# What a ping has besides its padding, about.
_ENVELOPE = 60
_LEAST, _LEAST_S = 12, 3.0
_CONNECT_S = 30.0
# To subscribe anew and to be there when the first turn comes.
_SET_UP_S = 0.3


def run(target: Target, say: Say) -> Section:
    """Measure every size at every rate that one connection may send."""
    section = Section("round_trips", "Round trips (table 6.4)")
    cells: dict[tuple[str, int], dict[str, list[list[float]]]] = {}
    with ExitStack() as stack:
        bundles = {path: target.robot(f"bench-rtt-{path}") for path in PING_PATHS}
        floor = target.robot("bench-rtt-raw")
        raw = stack.enter_context(RawClient(floor.folder))
        uplinks = {path: stack.enter_context(_Connected(bundle)) for path, bundle in bundles.items()}
        topic = build_topic(PING, floor.robot, BROKER, target.cloud.namespace)
        raw.subscribe(topic)
        floors = _floors(target, raw)
        for repeat, (size, rate_hz) in product(range(REPEATS), product(SIZES, RATES_HZ)):
            if SIZES[size] * rate_hz > BYTES_PER_S:
                continue
            say(f"{size} at {rate_hz} Hz, {repeat + 1} of {REPEATS}")
            found = _cell(uplinks, raw, topic, size=SIZES[size], rate_hz=rate_hz)
            cell = cells.setdefault((size, rate_hz), {name: [] for name in found})
            for name, values in found.items():
                cell[name].append(values)
    _report(section, cells, floors, target)
    lost = sum(uplink.lost for uplink in uplinks.values())
    section.ratios.append(Ratio("pings that did not come back", lost, 0, "pings"))
    return section


class _Connected:
    """The agent's uplink of a bundle, connected from `__enter__` to `__exit__`."""

    def __init__(self, bundle: Bundle) -> None:
        self.config = load_config(bundle.config)
        self.clock = SystemClock()
        self.lost = 0
        self.uplink = IotCore(
            endpoint=self.config.endpoint,
            port=self.config.port,
            client_id=self.config.robot,
            certificate=self.config.certificate,
            private_key=self.config.private_key,
            root_ca=self.config.root_ca,
            clock=self.clock,
            dispatcher=Dispatcher(),
        )

    def __enter__(self) -> Self:
        connected = threading.Event()
        self.uplink.on_connection(lambda up: connected.set() if up else None)
        self.uplink.start()
        if not connected.wait(_CONNECT_S):
            raise BenchError(f"{self.config.robot} was not connected within {_CONNECT_S:.0f} s")
        return self

    def __exit__(self, *_: object) -> None:
        self.uplink.stop(5.0)

    def measure(self, path: str, rate_hz: float, size: int, begins: float, seconds: float) -> list[float]:
        """Round trips over a path from then on, in milliseconds, by the agent's own pings."""
        trips: list[float] = []

        def emit(_stream: str, _t_us: int, values: Any) -> None:
            value: Value = values[RTT_FIELDS[path]]
            if isinstance(value, (int, float)):
                trips.append(float(value))

        pings = Pings(
            robot=self.config.robot,
            namespace=self.config.namespace,
            paths=[path],
            rate_hz=rate_hz,
            padding_bytes=max(0, size - _ENVELOPE),
            uplink=self.uplink,
            clock=self.clock,
            # It is `RATES_HZ` and `SIZES` that keep below the limits here.
            allowance=Allowance(self.clock, publishes_per_s=1e6, bytes_per_s=1e9),
            emit=emit,
            on_stamp=lambda _sent, _received, _stamp_ms: None,
        )
        stop = threading.Event()
        lane = PING if path == BROKER else PONG
        answers = build_topic(lane, self.config.robot, path, self.config.namespace)
        while not self.uplink.subscribed(answers):
            stop.wait(0.02)
        stop.wait(max(0.0, begins - time.perf_counter()))
        runner = threading.Thread(target=pings.run, args=(stop,), daemon=True)
        runner.start()
        stop.wait(seconds)
        stop.set()
        pings.wake()
        runner.join()
        pings.close(5.0)
        self.lost += pings.report()[path].lost
        return trips


def seconds(rate_hz: float) -> float:
    """How long a size is measured at a rate, once."""
    return max(_LEAST_S, _LEAST / rate_hz / 3)


def _cell(
    uplinks: dict[str, _Connected], raw: RawClient, topic: str, *, size: int, rate_hz: int
) -> dict[str, list[float]]:
    """Every path and the floor at the same time, each on its own connection."""
    lasts_s = seconds(rate_hz)
    found: dict[str, list[float]] = {}

    # Each in its own part of the period, so that none waits for another's message.
    names = (*uplinks, RAW)
    starts_s = {name: i / len(names) / rate_hz for i, name in enumerate(names)}
    began = time.perf_counter() + _SET_UP_S
    pause = threading.Event()

    def ours(path: str) -> None:
        found[path] = uplinks[path].measure(path, rate_hz, size, began + starts_s[path], lasts_s)

    def floor() -> None:
        payload = encode_ping(1, time.time_ns() // 1000, "x" * max(0, size - _ENVELOPE))
        values = []
        for turn in range(max(1, round(lasts_s * rate_hz))):
            due = began + starts_s[RAW] + turn / rate_hz
            pause.wait(max(0.0, due - time.perf_counter()))
            values.append(raw.round_trip(topic, payload) * 1000)
        found[RAW] = values

    threads = [threading.Thread(target=ours, args=(path,)) for path in uplinks]
    threads.append(threading.Thread(target=floor))
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    missing = [name for name in names if not found.get(name)]
    if missing:
        raise BenchError(f"nothing was measured over {', '.join(missing)}")
    return found


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
    target: Target,
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
    if target.embedded is not None:
        section.notes.append(
            "On loopback there is no way to travel: the thesis' figures hold the Internet between car and "
            "AWS, so compare the ratios, and add your own ping."
        )
    section.raw = {
        "cells": {f"{size} at {rate} Hz": _rounded(cell) for (size, rate), cell in cells.items()},
        "floors": {name: asdict(one) for name, one in shown_floors.items() if one is not None},
    }


def _rounded(cell: dict[str, list[list[float]]]) -> dict[str, Any]:
    summary = {name: spread(repeats) for name, repeats in cell.items()}
    return {name: {k: round(v, 4) for k, v in asdict(one).items()} for name, one in summary.items() if one}
