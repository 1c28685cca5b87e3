"""Table 6.4: robot - broker, robot - broker - rule, robot - broker - Lambda, beside the physical limits.

Each path has a connection of its own, by the agent's own uplink and pings, and so has the floor: the
smallest MQTT client there can be, on the same broker at the same rate at the same time. On the embedded
cloud everything is measured again with the ping of the thesis added (`bench.sections.round_trips`)."""

from __future__ import annotations

import threading
import time
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from itertools import product
from statistics import median

from typing_extensions import Self

from bench import plots
from bench.floors.raw_mqtt import RawClient, tcp_connect_s
from bench.report import NOT_MEASURED, Section, ratio, rounded, spread, text
from bench.sections import Declared
from bench.thesis import PING_MS, SOURCE
from iort_agent.mqtt.rate_limiter import BYTES_PER_S
from iort_contract.catalog.questions import CALIBRATION
from iort_contract.catalog.vesc import VESC_STREAM
from iort_contract.messages.live import encode_ping
from iort_contract.tables import T_US
from iort_contract.topics import BROKER, LAMBDA, PING, PING_PATHS, RULE, build_topic
from iort_station.fleet.robots import Bundle
from iort_station.page.page import load_keys
from iort_station.page.pubnub import Listener
from local.figures import THESIS, THESIS_MS
from local.network.proxy import Proxy
from testkit.car import ENVELOPE, AgentProcess, Connected, asking, round_trips_ms
from testkit.target import Say, Target
from testkit.waiting import InstrumentError

RAW = "raw client"
# Time to subscribe again before the first ping.
_SET_UP_S = 0.3


class RoundTrips:
    """One uplink of the agent for each path, and the raw client, connected from `__enter__` to `__exit__`.

    ``port`` is the port of a proxy before the broker, if there is one.
    """

    def __init__(
        self, bundles: Mapping[str, Bundle], floor: Bundle, namespace: str, port: int | None = None
    ) -> None:
        self._uplinks = {path: Connected(bundle, port) for path, bundle in bundles.items()}
        self.raw = RawClient(floor.folder, port)
        self._topic = build_topic(PING, floor.robot, BROKER, namespace)
        self._exit = ExitStack()

    def __enter__(self) -> Self:
        with ExitStack() as stack:
            for uplink in self._uplinks.values():
                stack.enter_context(uplink)
            stack.enter_context(self.raw)
            self.raw.subscribe(self._topic)
            self._exit = stack.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        self._exit.close()

    @property
    def lost(self) -> int:
        """Pings that did not come back."""
        return sum(uplink.lost for uplink in self._uplinks.values())

    def measure(self, *, size: int, rate_hz: int, lasts_s: float) -> dict[str, list[float]]:
        """Return the round trips in ms over each path and of the floor, measured for ``lasts_s`` seconds."""
        names = (*self._uplinks, RAW)
        began = time.perf_counter() + _SET_UP_S
        with ThreadPoolExecutor(len(names)) as pool:
            # Each has its own part of the period, so that none waits for another's message.
            begins = {name: began + i / len(names) / rate_hz for i, name in enumerate(names)}
            running = {}
            for name in names:
                measure = self._raw if name == RAW else self._uplinks[name].measure
                running[name] = pool.submit(measure, name, rate_hz, size, begins[name], lasts_s)
            found = {name: trips.result() for name, trips in running.items()}
        if missing := [name for name, trips in found.items() if not trips]:
            raise InstrumentError(f"nothing was measured over {', '.join(missing)}")
        return found

    def _raw(self, _: str, rate_hz: float, size: int, begins: float, seconds: float) -> list[float]:
        payload = encode_ping(1, time.time_ns() // 1000, "x" * max(0, size - ENVELOPE))
        values: list[float] = []
        due, pause = begins, threading.Event()
        # One at a time: if a round trip takes longer than the period, the next ping leaves when it ends.
        while due < begins + seconds:
            pause.wait(max(0.0, due - time.perf_counter()))
            values.append(self.raw.round_trip(self._topic, payload) * 1000)
            due = max(due + 1 / rate_hz, time.perf_counter())
        return values


ONE_WAY_S = PING_MS / 2 / 1000
WITH = f"with {ONE_WAY_S * 1000:.0f} ms each way"
SIZE = 512
RATES_HZ = (1, 10, 50)
DASHBOARD, ECHO = "dashboard", "TLS echo (PINGREQ)"
_REPEATS, _LASTS_S = 3, 4.0
_DRIVE_S, _WARM_UP_S = 12.0, 3.0
# Values in ms, a list a repeat.
Repeats = list[list[float]]


def measure(target: Target, bundles: Mapping[str, Bundle], floor: Bundle, say: Say) -> dict[str, Repeats]:
    """Return the values by ``<way> at <rate> Hz``, and those of the dashboard and the echo."""
    found: dict[str, Repeats] = {}
    cloud = target.cloud
    with Proxy(cloud.mqtt_endpoint, cloud.mqtt_port, latency_s=ONE_WAY_S) as proxy:
        with RoundTrips(bundles, floor, cloud.namespace, proxy.port) as lines:
            for repeat in range(_REPEATS):
                for rate_hz in RATES_HZ:
                    say(f"{WITH}, {rate_hz} Hz, {repeat + 1} of {_REPEATS}")
                    for way, values in lines.measure(size=SIZE, rate_hz=rate_hz, lasts_s=_LASTS_S).items():
                        found.setdefault(f"{way} at {rate_hz} Hz", []).append(values)
            found[ECHO] = [[lines.raw.ping() * 1000 for _ in range(20)]]
        if lines.lost:
            raise InstrumentError(f"{WITH}: {lines.lost} pings did not come back")
        say(f"{WITH}, to a PubNub subscriber")
        found[DASHBOARD] = [_to_subscriber(target, proxy.port)]
    return found


def _to_subscriber(target: Target, port: int) -> list[float]:
    """Return the delays in ms from the sample in a driving car to the subscriber, by one clock."""
    source = {"type": "sim", "stream": VESC_STREAM, "rate_hz": 50, "pose": {"rate_hz": 0}}
    bundle = target.robot("bench-far", port=port, sources=[source], live={"when": "always"})
    pubnub = load_keys(target.cloud).reading()
    host, _, its_port = pubnub.pop("origin").partition(":")
    delays_ms: list[float] = []
    with (
        Proxy(host, int(its_port), latency_s=ONE_WAY_S) as proxy,
        Listener(
            robot=bundle.robot,
            namespace=target.cloud.namespace,
            origin=f"{host}:{proxy.port}",
            on_update=lambda update, _, here_us: delays_ms.append((here_us - update[T_US]) / 1000),
            **pubnub,
        ),
        AgentProcess(bundle),
    ):
        threading.Event().wait(_WARM_UP_S)
        delays_ms.clear()
        threading.Event().wait(_DRIVE_S)
        measured = list(delays_ms)
    if not measured:
        raise InstrumentError(f"{WITH}: no live update was heard")
    return measured


def report(section: Section, found: Mapping[str, Repeats]) -> None:
    """Add the table, the picture and the ratios."""
    names = {path: f"robot - {path}" for path in PING_PATHS} | {RAW: RAW, DASHBOARD: "car to subscriber"}
    theirs = {way: f"{most} ms" for way, most in THESIS.items()}

    def row(name: str, way: str, thesis: str) -> list[str]:
        values = (found.get(f"{way} at {rate_hz} Hz", []) for rate_hz in RATES_HZ)
        return [f"{name}, {WITH}", *(text(each, digits=1) for each in values), thesis]

    rows = [row(names[path], path, theirs[path]) for path in PING_PATHS]
    rows.append(row("floor: raw MQTT client", RAW, NOT_MEASURED))
    live, echo = (text(found[way], digits=1) for way in (DASHBOARD, ECHO))
    rows.append([f"car to PubNub subscriber, {WITH}", NOT_MEASURED, live, NOT_MEASURED, theirs[DASHBOARD]])
    rows.append([f"{ECHO}, {WITH}", echo, NOT_MEASURED, NOT_MEASURED, f"{PING_MS} ms (ping)"])
    section.table(
        f"With the thesis' ping, 0.5 KB {WITH}: median (p95, p99; range)",
        ["way", *(f"at {rate_hz} Hz" for rate_hz in RATES_HZ), "thesis, 2018"],
        rows,
    )
    usual = {way: found[f"{way} at 10 Hz"] for way in (*PING_PATHS, RAW)} | {DASHBOARD: found[DASHBOARD]}
    spreads = {way: one for way, values in usual.items() if (one := spread(values)) is not None}
    ranges: dict[str, dict[str, tuple[float, float]]] = {
        "iort, median to p95": {names[way]: (one.p50, one.p95) for way, one in spreads.items()},
        "thesis": {names[way]: THESIS_MS[way] for way in spreads if way in THESIS_MS},
    }
    title = f"0.5 KB at 10 Hz {WITH}, and the {SOURCE}"
    section.plot("round-trips-far", title, plots.ranges([names[way] for way in spreads], ranges, unit="ms"))
    beside = ratio(usual[BROKER], usual[RAW])
    section.ratio(f"broker round trip / raw MQTT client, {WITH}", beside and round(beside, 3), 1.1)
    for way in (*PING_PATHS, DASHBOARD):
        most = THESIS_MS[way][1]
        share = round(median(value for values in usual[way] for value in values) / most, 3)
        section.ratio(f"{names[way]} {WITH} / thesis' {most} ms", share, 1.0, by_machine=True)
    section.notes.append(
        f"The thesis' figures hold a ping of {PING_MS} ms between car and cloud; {WITH}, by a proxy before "
        "the broker, ours hold the same. The way to the subscriber has as much again between PubNub and the "
        "subscriber. The raw client sends one message at a time, so at most 20 a second there."
    )
    section.raw["far"] = rounded(found, 3)


SIZES = {"0.5 KB": 512, "5 KB": 5 * 1024, "50 KB": 50 * 1024, "127 KB": 127 * 1024 - 200}
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
        report(section, measure(target, bundles, floor, say))
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


SECTION = Declared("round trips over every path, beside the barest client", run)
