"""Table 6.4: robot - broker, robot - broker - rule, robot - broker - Lambda, beside the physical limits.

Each path has a connection of its own, by the agent's own uplink and pings, and so has the floor: the
smallest MQTT client there can be, on the same broker at the same rate at the same time. On the embedded
cloud the small messages are measured again with the ping of the thesis, by a proxy that delays every byte."""

from __future__ import annotations

import threading
import time
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from itertools import product
from statistics import median

from typing_extensions import Self

from bench.floors.raw_mqtt import RawClient, tcp_connect_s
from bench.report import NOT_MEASURED, Section, ratio, spread, text
from bench.sections import Declared
from bench.thesis import PING_MS
from iort_agent.mqtt.rate_limiter import BYTES_PER_S
from iort_contract.catalog.vesc import VESC_STREAM
from iort_contract.messages.live import encode_ping
from iort_contract.tables import T_US
from iort_contract.topics import BROKER, LAMBDA, PING, PING_PATHS, RULE, build_topic
from iort_station.fleet.robots import Bundle
from iort_station.page.page import load_keys
from iort_station.page.pubnub import Listener
from local.figures import THESIS, THESIS_MS
from testkit.car import ENVELOPE, AgentProcess, Connected
from testkit.proxy import Proxy
from testkit.target import Say, Target
from testkit.waiting import InstrumentError

SMALL = "0.5 KB"
SIZES = {SMALL: 512, "5 KB": 5 * 1024, "50 KB": 50 * 1024, "127 KB": 127 * 1024 - 200}
RATES_HZ = (1, 10, 50)
RAW, DASHBOARD = "raw client", "dashboard"
ONE_WAY_S = PING_MS / 2 / 1000
FAR = f"with {ONE_WAY_S * 1000:.0f} ms each way"
_REPEATS, _LEAST, _LEAST_S = 3, 12, 3.0
# Time to subscribe again before the first ping.
_SET_UP_S = 0.3
_DRIVE_S, _WARM_UP_S = 12.0, 3.0
# Round trips in ms by way, a list a repeat; and those of each size and rate.
Cell = dict[str, list[list[float]]]
Cells = dict[tuple[str, int], Cell]


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

    def cells(self, sizes: Mapping[str, int], say: Say) -> Cells:
        """Measure every size at every rate that one connection may send, in turns."""
        cells: Cells = {}
        for repeat, (size, rate_hz) in product(range(_REPEATS), product(sizes, RATES_HZ)):
            if sizes[size] * rate_hz <= BYTES_PER_S:
                say(f"{size} at {rate_hz} Hz, {repeat + 1} of {_REPEATS}")
                for way, trips in self._measure(sizes[size], rate_hz).items():
                    cells.setdefault((size, rate_hz), {}).setdefault(way, []).append(trips)
        return cells

    def _measure(self, size: int, rate_hz: int) -> dict[str, list[float]]:
        names = (*self._uplinks, RAW)
        began, lasts_s = time.perf_counter() + _SET_UP_S, max(_LEAST_S, _LEAST / rate_hz / 3)
        with ThreadPoolExecutor(len(names)) as pool:
            running = {}
            for i, name in enumerate(names):
                measure = self._raw if name == RAW else self._uplinks[name].measure
                # Each has its own part of the period, so that none waits for another's message.
                begins = began + i / len(names) / rate_hz
                running[name] = pool.submit(measure, name, rate_hz, size, begins, lasts_s)
            trips = {name: future.result() for name, future in running.items()}
        if missing := [name for name, values in trips.items() if not values]:
            raise InstrumentError(f"nothing was measured over {', '.join(missing)}")
        return trips

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


def run(target: Target, say: Say) -> Section:
    """Measure every size; on the embedded cloud the small one again, over the thesis' ping."""
    section, cloud = Section("round_trips", "Round trips (table 6.4)"), target.cloud
    bundles = {path: target.robot(f"bench-rtt-{path}") for path in PING_PATHS}
    floor = target.robot("bench-rtt-raw")
    with RoundTrips(bundles, floor, cloud.namespace) as lines:
        handshakes = [tcp_connect_s(cloud.mqtt_endpoint, cloud.mqtt_port) * 1000 for _ in range(30)]
        echoes = [lines.raw.ping() * 1000 for _ in range(100)]
        cells = lines.cells(SIZES, say)
    report(section, cells, {"TCP handshake (ping)": handshakes, "TLS echo (PINGREQ)": echoes})
    section.ratio("pings that did not come back", lines.lost, 0, unit="pings")
    if target.embedded is None:
        return section
    with Proxy(cloud.mqtt_endpoint, cloud.mqtt_port, latency_s=ONE_WAY_S) as proxy:
        with RoundTrips(bundles, floor, cloud.namespace, proxy.port) as lines:
            far = lines.cells({SMALL: SIZES[SMALL]}, lambda step: say(f"{FAR}, {step}"))
        if lines.lost:
            raise InstrumentError(f"{FAR}: {lines.lost} pings did not come back")
        say(f"{FAR}, to a PubNub subscriber")
        report_far(section, far, _to_subscriber(target, proxy.port))
    return section


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
        raise InstrumentError(f"{FAR}: no live update was heard")
    return measured


def _table(section: Section, title: str, cells: Cells) -> None:
    rows = []
    for (size, rate_hz), cell in cells.items():
        times = ratio(cell[BROKER], cell[RAW])
        shown = NOT_MEASURED if times is None else f"{times:.2f}"
        rows.append([f"{size} at {rate_hz} Hz", *(text(cell[way]) for way in (*PING_PATHS, RAW)), shown])
    rows.append(["thesis, 2018", *(f"{THESIS[path]} ms" for path in PING_PATHS), NOT_MEASURED, NOT_MEASURED])
    head = ["payload", "broker", "rule republish", "Lambda", "floor: raw MQTT client", "broker / floor"]
    section.table(title, head, rows)


def report(section: Section, cells: Cells, floors: dict[str, list[float]]) -> None:
    """Add the tables and the ratios of all sizes."""
    _table(section, "Round trips: median (p95)", cells)
    limits = [[name, text([values], digits=3)] for name, values in floors.items()]
    section.table("Physical limits to the same endpoint, same run", ["limit", "round trip"], limits)
    small = [ratio(cell[BROKER], cell[RAW]) or 0.0 for (size, _), cell in cells.items() if size == SMALL]
    section.ratio("broker round trip / raw MQTT client", median(small), 1.5)
    usual = cells[SMALL, 10]
    for path in (RULE, LAMBDA):
        section.ratio(f"round trip over {path} / over broker", ratio(usual[path], usual[BROKER]), None)
    section.notes.append(
        f"A connection may send {BYTES_PER_S // 1024} KB a second (AWS' quota), so the larger payloads are "
        "not measured at the higher rates. 127 KB is the largest message of the contract: AWS closes "
        "a connection that sends more than 128 KB."
    )
    section.raw = {"floors_ms": floors, **_medians(cells)}


def report_far(section: Section, cells: Cells, live_ms: list[float]) -> None:
    """Add the table and the ratios of the thesis' ping."""
    _table(section, f"With the thesis' ping, {FAR}: median (p95)", cells)
    usual = cells[SMALL, 10]
    section.ratio(f"broker round trip / raw MQTT client, {FAR}", ratio(usual[BROKER], usual[RAW]), 1.1)
    ways = {f"robot - {path}": (path, usual[path]) for path in PING_PATHS}
    ways["car to subscriber"] = (DASHBOARD, [live_ms])
    for name, (way, values) in ways.items():
        most, took = THESIS_MS[way][1], spread(values).p50
        share = None if took is None else took / most
        section.ratio(f"{name} {FAR} / thesis' {most} ms", share, 1.0, by_machine=True)
    section.notes.append(
        f"The thesis' figures hold a ping of {PING_MS} ms between car and cloud; {FAR}, by a proxy before "
        f"the broker, ours hold the same. To the PubNub subscriber, with as much again before it, "
        f"{text([live_ms], digits=1)} (thesis: {THESIS[DASHBOARD]} ms). The raw client sends one message at "
        "a time, so at most 20 a second there."
    )
    section.raw["far"] = _medians(cells)


def _medians(cells: Cells) -> dict[str, dict[str, float | None]]:
    return {
        f"{size} at {rate_hz} Hz": {way: spread(values).p50 for way, values in cell.items()}
        for (size, rate_hz), cell in cells.items()
    }


SECTION = Declared("round trips over every path, beside the barest client", run, dollars=0.04)
