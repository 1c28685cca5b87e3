"""Round trips, and the delay to the dashboard, with the ping of the thesis added, beside its figures.

The project's proxy stands before the broker, and another before PubNub's stand-in: each delays every byte by
25 ms, both ways. The thesis' car had a ping of 50 ms to its cloud.
"""

from __future__ import annotations

import threading
from collections.abc import Mapping
from statistics import median

from bench.meters.round_trips import RAW, RoundTrips
from bench.report import plots
from bench.report.result import NOT_MEASURED, Section
from bench.report.spread import ratio, rounded, spread, text
from bench.report.thesis import PING_MS, SOURCE
from iort_contract.catalog.vesc import VESC_STREAM
from iort_contract.tables import T_US
from iort_contract.topics import BROKER, PING_PATHS
from iort_station.fleet.robots import Bundle
from iort_station.page.page import load_keys
from iort_station.page.pubnub import Listener
from local.figures import THESIS, THESIS_MS
from local.network.proxy import Proxy
from testkit.car import AgentProcess
from testkit.target import Say, Target
from testkit.waiting import InstrumentError

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
