"""Outage: the connection to the broker is cut for a minute while a car drives at 50 Hz.

On the embedded cloud a proxy between car and broker resets every connection; on AWS the car's certificate
is deactivated, which ends its session and refuses new ones.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from statistics import median
from typing import Any

from bench.errors import BenchError
from bench.load.agent_process import AgentProcess
from bench.report import plots
from bench.report.result import Plot, Ratio, Section, Table
from bench.report.spread import spread
from bench.target import Say, Target
from iort_agent.config.file import load_config
from iort_contract.catalog.streams import OWN_STREAMS
from iort_contract.catalog.vesc import VESC_STREAM
from iort_contract.messages.batch import batch_id
from iort_contract.tables import BATCH
from iort_station.fleet import robots
from iort_station.fleet.robots import Bundle
from iort_station.operations import audit, delivery
from local.proxy import PASS, REFUSE, Proxy

ROBOT = "bench-outage"
RATE_HZ = 50
# After the outage the agent may wait for its next attempt, and must still drive then.
BEFORE_S, CUT_S, AFTER_S = 8, 60, 30
_SUMMARY_S = 60.0


def run(target: Target, say: Say) -> Section:
    """Drive, cut the connection, restore it; then count the stored samples and the live updates."""
    section = Section("outage", "Outage: no broker for 60 s at 50 Hz")
    seconds = BEFORE_S + CUT_S + AFTER_S
    source = {"type": "sim", "stream": VESC_STREAM, "rate_hz": RATE_HZ, "duration_s": seconds}
    bundle = target.robot(ROBOT, sources=[source], queue={"path": "queue.db"})
    with (
        _way(target, bundle) as way,
        target.listener(bundle.robot) as listener,
        AgentProcess(bundle) as agent,
    ):
        _wait_for(lambda: bool(listener.heard), "the first live update")
        say(f"driving for {BEFORE_S} s")
        threading.Event().wait(BEFORE_S)
        cut_us = time.time_ns() // 1000
        way.cut()
        for left_s in range(CUT_S, 0, -10):
            say(f"cut, {left_s} s to go")
            threading.Event().wait(10)
        way.mend()
        mended_us = time.time_ns() // 1000
        say("draining")
        report = agent.finished()
        heard = list(listener.heard)
    sent = sum(s["samples"] for name, s in report["streams"].items() if name not in OWN_STREAMS)
    # Lost samples never arrive: they are counted after the wait.
    with suppress(BenchError):
        _wait_for(
            lambda: delivery.samples_summarized(target.cloud, bundle.robot, VESC_STREAM) >= sent,
            "Lambda 2",
            _SUMMARY_S,
        )
    items = list(audit.headers(target.cloud, bundle.robot, VESC_STREAM))
    found = audit.audit(VESC_STREAM, items, from_start=True)
    stored = sum(int(item["n"]) for item in items)
    delayed = [i for i in items if cut_us <= batch_id(i[BATCH]).t_us < mended_us]
    drained_ms = max((int(item["received_ms"]) for item in delayed), default=mended_us // 1000)
    live = [(h.t_us, h.delay_ms) for h in heard if h.stream == VESC_STREAM]
    _report(
        section,
        lost=sent - stored,
        summarized=delivery.samples_summarized(target.cloud, bundle.robot, VESC_STREAM),
        sent=sent,
        duplicated=sum(run.duplicated for run in found.runs),
        missing=found.missing,
        drain_s=drained_ms / 1000 - mended_us / 1e6,
        live=live,
        cut_us=cut_us,
        mended_us=mended_us,
    )
    return section


def _report(
    section: Section,
    *,
    lost: int,
    summarized: int,
    sent: int,
    duplicated: int,
    missing: int,
    drain_s: float,
    live: list[tuple[int, float]],
    cut_us: int,
    mended_us: int,
) -> None:
    before = [delay for t_us, delay in live if t_us < cut_us]
    back = [t_us for t_us, _ in live if t_us >= mended_us]
    first_s = (min(back) - mended_us) / 1e6 if back else float("nan")
    draining = [d for t_us, d in live if t_us >= mended_us and t_us < mended_us + max(drain_s, 1.0) * 1e6]
    after = [delay for t_us, delay in live if t_us >= mended_us]
    meanwhile = sum(cut_us + 1e6 < t_us < mended_us for t_us, _ in live)
    shown = {
        name: spread([values])
        for name, values in (("before", before), ("during", draining), ("after", after))
    }
    rows = [
        ["samples sent by the car", f"{sent:,}"],
        ["samples lost", f"{lost:,}"],
        ["samples not summarised", f"{sent - summarized:,}"],
        ["batches missing, by their numbers", str(missing)],
        ["batches stored twice", str(duplicated)],
        ["from the way's return to the backlog's last batch in the table", f"{drain_s:.1f} s"],
        ["from the way's return to the first live sample", f"{first_s:.1f} s" if back else "none was sent"],
        ["live delay before", shown["before"].text() if shown["before"] else "-"],
        [
            "live delay while the backlog drained",
            shown["during"].text() if shown["during"] else "none was sent",
        ],
        ["live delay from the way's return on", shown["after"].text() if shown["after"] else "-"],
        ["live samples of the outage that came late to the dashboard", str(meanwhile)],
    ]
    section.tables.append(Table("A minute without a broker", ["figure", "measured"], rows))
    section.ratios += [
        Ratio("samples lost over an outage", lost, 0, "samples"),
        Ratio("batches stored twice over an outage", duplicated, 0, "batches"),
        # Most of it is the random wait before the agent's next attempt.
        Ratio("time to drain / outage", round(drain_s / CUT_S, 4), 0.5, tolerance=4),
    ]
    if after and before:
        section.ratios.append(
            Ratio("live delay after / before", round(median(after) / median(before), 3), None, tolerance=2)
        )
    title = "Live updates over an outage"
    start = cut_us - BEFORE_S * 1_000_000
    points = ([(t_us - start) / 1e6 for t_us, _ in live], [delay for _, delay in live])
    shaded = ((cut_us - start) / 1e6, (mended_us - start) / 1e6)
    section.plots.append(
        Plot(
            "outage",
            title,
            plots.points(
                title,
                {"live update": points},
                x_label="s",
                y_label="ms from car to subscriber",
                shaded=shaded,
            ),
        )
    )
    section.raw = {
        "sent": sent,
        "lost": lost,
        "drain_s": drain_s,
        "first_live_s": first_s,
        "duplicated": duplicated,
    }


class _Proxied:
    def __init__(self, proxy: Proxy) -> None:
        self._proxy = proxy

    def cut(self) -> None:
        self._proxy.mode = REFUSE

    def mend(self) -> None:
        self._proxy.mode = PASS


class _Certificate:
    """AWS ends the sessions of a certificate that is deactivated, and refuses new ones.

    A refused agent waits for minutes, or until its certificate file changes: `mend` touches the file.
    """

    def __init__(self, target: Target, bundle: Bundle) -> None:
        self._iot, self._file = target.cloud.client("iot"), load_config(bundle.config).certificate
        principals = self._iot.list_thing_principals(thingName=bundle.robot)["principals"]
        self._certificate = principals[0].rsplit("/", 1)[-1]

    def cut(self) -> None:
        self._iot.update_certificate(certificateId=self._certificate, newStatus="INACTIVE")

    def mend(self) -> None:
        self._iot.update_certificate(certificateId=self._certificate, newStatus="ACTIVE")
        self._file.touch()


@contextmanager
def _way(target: Target, bundle: Bundle) -> Iterator[Any]:
    if target.embedded is None:
        yield _Certificate(target, bundle)
        return
    with Proxy(target.cloud.mqtt_endpoint, target.cloud.mqtt_port) as proxy:
        robots.configure(bundle, {"endpoint": "127.0.0.1", "port": proxy.port})
        yield _Proxied(proxy)


def _wait_for(true: Any, what: str, seconds: float = 30.0) -> None:
    deadline = time.monotonic() + seconds
    while not true():
        if time.monotonic() > deadline:
            raise BenchError(f"waited {seconds:.0f} s for {what}")
        threading.Event().wait(0.1)
