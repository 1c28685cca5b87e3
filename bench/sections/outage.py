"""Outage: the connection to the broker is cut for a minute while a car drives at 50 Hz.

On the embedded cloud a proxy between car and broker resets every connection; on AWS the car's certificate
is deactivated, which ends its session and refuses new ones.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from statistics import median

from bench.report import Section, text
from bench.sections import Declared
from iort_agent.config import load_config
from iort_contract.catalog.streams import OWN_STREAMS
from iort_contract.catalog.vesc import VESC_STREAM
from iort_contract.messages.batch import batch_id
from iort_contract.tables import BATCH
from iort_station.fleet import robots
from iort_station.fleet.robots import Bundle
from iort_station.operations import audit
from testkit.car import AgentProcess
from testkit.proxy import PASS, REFUSE, Proxy
from testkit.target import Say, Target
from testkit.waiting import reached, until

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
    seconds = BEFORE_S + CUT_S + AFTER_S
    source = {"type": "sim", "rate_hz": RATE_HZ, "duration_s": seconds, "pose": {"rate_hz": 0}}
    bundle = target.robot(
        "bench-outage", sources=[source], queue={"path": "queue.db"}, live={"when": "always"}
    )
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
        say(f"cut for {CUT_S} s")
        threading.Event().wait(CUT_S)
        mend()
        mended_us = time.time_ns() // 1000
        say("draining")
        streams = agent.finished()["streams"]
        heard = list(listener.heard)
    sent = sum(stream["samples"] for name, stream in streams.items() if name not in OWN_STREAMS)

    def summarized() -> int:
        return audit.samples_summarized(target.cloud, bundle.robot, VESC_STREAM)

    # Lost samples never arrive: they are counted after the wait.
    reached(lambda: summarized() >= sent, within_s=_SUMMARY_S)
    items = list(audit.headers(target.cloud, bundle.robot, VESC_STREAM))
    audited = audit.audit(VESC_STREAM, items, from_start=True)
    delayed = [item for item in items if cut_us <= batch_id(item[BATCH]).t_us < mended_us]
    drained_ms = max((int(item["received_ms"]) for item in delayed), default=mended_us // 1000)
    return report(
        Outage(
            sent=sent,
            lost=sent - sum(int(item["n"]) for item in items),
            summarized=summarized(),
            duplicated=sum(run.duplicated for run in audited.runs),
            missing=audited.missing,
            drain_s=drained_ms / 1000 - mended_us / 1e6,
            live=[(update.t_us, update.delay_ms) for update in heard if update.stream == VESC_STREAM],
            cut_us=cut_us,
            mended_us=mended_us,
        )
    )


def report(outage: Outage) -> Section:
    """Make the section of an outage."""
    section, live, mended_us = (
        Section("outage", "Outage: no broker for 60 s at 50 Hz"),
        outage.live,
        outage.mended_us,
    )
    before = [delay for t_us, delay in live if t_us < outage.cut_us]
    after = [delay for t_us, delay in live if t_us >= mended_us]
    first_s = min(((t_us - mended_us) / 1e6 for t_us, _ in live if t_us >= mended_us), default=None)
    meanwhile = sum(outage.cut_us + 1e6 < t_us < mended_us for t_us, _ in live)
    section.table(
        "A minute without a broker",
        ["figure", "measured"],
        [
            ["samples sent by the car", f"{outage.sent:,}"],
            ["samples lost", f"{outage.lost:,}"],
            ["samples not summarised", f"{outage.sent - outage.summarized:,}"],
            ["batches missing, by their numbers", str(outage.missing)],
            ["batches stored twice", str(outage.duplicated)],
            ["from the way's return to the backlog's last batch in the table", f"{outage.drain_s:.1f} s"],
            [
                "from the way's return to the first live sample",
                "none was sent" if first_s is None else f"{first_s:.1f} s",
            ],
            ["live delay before", text([before])],
            ["live delay from the way's return on", text([after])],
            ["live samples of the outage that came late to the dashboard", str(meanwhile)],
        ],
    )
    section.ratio("samples lost over an outage", outage.lost, 0, unit="samples")
    section.ratio("batches stored twice over an outage", outage.duplicated, 0, unit="batches")
    # Most of it is the random wait before the agent's next attempt.
    section.ratio("time to drain / outage", outage.drain_s / CUT_S, 0.5, tolerance=4)
    if after and before:
        section.ratio("live delay after / before", median(after) / median(before), None, tolerance=2)
    section.raw = {**asdict(outage), "live": len(live), "first_live_s": first_s}
    return section


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

    def cut() -> None:
        iot.update_certificate(certificateId=number, newStatus="INACTIVE")

    def mend() -> None:
        iot.update_certificate(certificateId=number, newStatus="ACTIVE")
        # A refused agent waits for minutes, or until its certificate file changes.
        file.touch()

    yield cut, mend


SECTION = Declared("a minute without a broker", run, dollars=0.001)
