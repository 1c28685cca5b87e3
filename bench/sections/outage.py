"""Outage: the connection to the broker is cut for a minute while a car drives at 50 Hz.

On the embedded cloud a proxy between car and broker resets every connection; on AWS the car's certificate
is deactivated, which ends its session and refuses new ones.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from statistics import median

from bench import plots
from bench.report import NOT_MEASURED, Section, spread
from bench.sections import Declared
from iort_agent.config import load_config
from iort_contract.catalog.streams import OWN_STREAMS
from iort_contract.catalog.vesc import VESC_STREAM
from iort_contract.messages.batch import batch_id
from iort_contract.tables import BATCH
from iort_station.fleet import robots
from iort_station.fleet.robots import Bundle
from iort_station.operations import audit
from local.network.proxy import PASS, REFUSE, Proxy
from testkit.car import AgentProcess
from testkit.target import Say, Target
from testkit.waiting import reached, until

ROBOT = "bench-outage"
RATE_HZ = 50
# After the outage the agent may wait for its next attempt, and must still drive then.
BEFORE_S, CUT_S, AFTER_S = 8, 60, 30
_SUMMARY_S = 60.0


@dataclass(frozen=True, kw_only=True)
class Outage:
    """The counts of samples and batches, and the time and delay in ms of every live update."""

    sent: int
    lost: int
    summarized: int
    duplicated: int
    missing: int
    drain_s: float
    live: list[tuple[int, float]]
    cut_us: int
    mended_us: int


def run(target: Target, say: Say) -> Section:
    """Drive, cut the connection, restore it; then count the stored samples and the live updates."""
    section = Section("outage", "Outage: no broker for 60 s at 50 Hz")
    seconds = BEFORE_S + CUT_S + AFTER_S
    source = {"type": "sim", "rate_hz": RATE_HZ, "duration_s": seconds, "pose": {"rate_hz": 0}}
    bundle = target.robot(ROBOT, sources=[source], queue={"path": "queue.db"}, live={"when": "always"})
    with (
        _way(target, bundle) as (cut, mend),
        target.listener(bundle.robot) as listener,
        AgentProcess(bundle) as agent,
    ):
        until(lambda: listener.heard, "the first live update")
        say(f"driving for {BEFORE_S} s")
        threading.Event().wait(BEFORE_S)
        cut_us = time.time_ns() // 1000
        cut()
        for left_s in range(CUT_S, 0, -10):
            say(f"cut, {left_s} s to go")
            threading.Event().wait(10)
        mend()
        mended_us = time.time_ns() // 1000
        say("draining")
        told = agent.finished()
        heard = list(listener.heard)
    sent = sum(s["samples"] for name, s in told["streams"].items() if name not in OWN_STREAMS)

    def summarized() -> int:
        return audit.samples_summarized(target.cloud, bundle.robot, VESC_STREAM)

    # Lost samples never arrive: they are counted after the wait.
    reached(lambda: summarized() >= sent, within_s=_SUMMARY_S)
    items = list(audit.headers(target.cloud, bundle.robot, VESC_STREAM))
    found = audit.audit(VESC_STREAM, items, from_start=True)
    delayed = [i for i in items if cut_us <= batch_id(i[BATCH]).t_us < mended_us]
    drained_ms = max((int(item["received_ms"]) for item in delayed), default=mended_us // 1000)
    outage = Outage(
        sent=sent,
        lost=sent - sum(int(item["n"]) for item in items),
        summarized=summarized(),
        duplicated=sum(run.duplicated for run in found.runs),
        missing=found.missing,
        drain_s=drained_ms / 1000 - mended_us / 1e6,
        live=[(h.t_us, h.delay_ms) for h in heard if h.stream == VESC_STREAM],
        cut_us=cut_us,
        mended_us=mended_us,
    )
    report(section, outage)
    return section


def report(section: Section, found: Outage) -> None:
    """Add the table, the picture and the ratios."""
    cut_us, mended_us, live = found.cut_us, found.mended_us, found.live
    drained_us = mended_us + max(found.drain_s, 1.0) * 1e6
    before = [delay for t_us, delay in live if t_us < cut_us]
    draining = [delay for t_us, delay in live if mended_us <= t_us < drained_us]
    after = [delay for t_us, delay in live if t_us >= mended_us]
    first_s = min(((t_us - mended_us) / 1e6 for t_us, _ in live if t_us >= mended_us), default=None)
    meanwhile = sum(cut_us + 1e6 < t_us < mended_us for t_us, _ in live)

    def delays(values: list[float], none: str) -> str:
        shown = spread([values])
        return shown.text() if shown else none

    section.table(
        "A minute without a broker",
        ["figure", "measured"],
        [
            ["samples sent by the car", f"{found.sent:,}"],
            ["samples lost", f"{found.lost:,}"],
            ["samples not summarised", f"{found.sent - found.summarized:,}"],
            ["batches missing, by their numbers", str(found.missing)],
            ["batches stored twice", str(found.duplicated)],
            ["from the way's return to the backlog's last batch in the table", f"{found.drain_s:.1f} s"],
            [
                "from the way's return to the first live sample",
                "none was sent" if first_s is None else f"{first_s:.1f} s",
            ],
            ["live delay before", delays(before, NOT_MEASURED)],
            ["live delay while the backlog drained", delays(draining, "none was sent")],
            ["live delay from the way's return on", delays(after, NOT_MEASURED)],
            ["live samples of the outage that came late to the dashboard", str(meanwhile)],
        ],
    )
    section.ratio("samples lost over an outage", found.lost, 0, unit="samples")
    section.ratio("batches stored twice over an outage", found.duplicated, 0, unit="batches")
    # Most of it is the random wait before the agent's next attempt.
    section.ratio("time to drain / outage", round(found.drain_s / CUT_S, 4), 0.5, tolerance=4)
    if after and before:
        later = round(median(after) / median(before), 3)
        section.ratio("live delay after / before", later, None, tolerance=2)

    def seconds(t_us: float) -> float:
        return (t_us - cut_us) / 1e6 + BEFORE_S

    times, waits = [seconds(t_us) for t_us, _ in live], [delay for _, delay in live]
    shaded = seconds(cut_us), seconds(mended_us)
    picture = plots.points("live update", times, waits, y_label="ms from car to subscriber", shaded=shaded)
    section.plot("outage", "Live updates over an outage", picture)
    section.raw = {
        "sent": found.sent,
        "lost": found.lost,
        "drain_s": found.drain_s,
        "first_live_s": first_s,
        "duplicated": found.duplicated,
    }


@contextmanager
def _way(target: Target, bundle: Bundle) -> Iterator[tuple[Callable[[], None], Callable[[], None]]]:
    """Yield functions that cut the car's way to the broker and mend it."""
    if target.embedded is not None:
        with Proxy(target.cloud.mqtt_endpoint, target.cloud.mqtt_port) as proxy:
            robots.configure(bundle, {"endpoint": "127.0.0.1", "port": proxy.port})
            yield lambda: setattr(proxy, "mode", REFUSE), lambda: setattr(proxy, "mode", PASS)
        return
    iot, file = target.cloud.client("iot"), load_config(bundle.config).certificate
    principals = iot.list_thing_principals(thingName=bundle.robot)["principals"]
    number = principals[0].rsplit("/", 1)[-1]

    def mend() -> None:
        iot.update_certificate(certificateId=number, newStatus="ACTIVE")
        # A refused agent waits for minutes, or until its certificate file changes.
        file.touch()

    def cut() -> None:
        iot.update_certificate(certificateId=number, newStatus="INACTIVE")

    yield cut, mend


SECTION = Declared("a minute without a broker", run)
