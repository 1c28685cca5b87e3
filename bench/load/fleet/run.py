"""One run of a fleet: every robot registered, driven by a process of its own, and counted in the tables."""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Any

from botocore.exceptions import BotoCoreError, ClientError

from bench.load.fleet.figures import Fleet
from bench.load.fleet.generator import Load
from iort_contract.catalog.vesc import VESC_STREAM
from iort_contract.messages.batch import batch_id
from iort_contract.tables import BATCH, RECEIVED_MS, SECOND
from iort_station.cloud import Cloud
from iort_station.data.recorded import summary_table, topic_of
from iort_station.fleet import robots
from iort_station.operations import audit
from iort_station.operations.audit import headers
from local.cloud import EmbeddedCloud
from local.figures import Spread
from testkit import ROOT, machine
from testkit.waiting import InstrumentError

# Takes the name of the step when it begins.
Tell = Callable[[str], None]
# After so long without a change no more summaries come.
_CATCH_UP_S = 120.0
# The processes that a deployment consists of here.
OURS = ("emulator", "Lambda workers")


def measure(
    embedded: EmbeddedCloud,
    count: int,
    seconds: int,
    tell: Tell,
    *,
    rate_hz: int = 50,
    prefix: str = "bench",
) -> Fleet:
    """Register ``count`` robots, drive them, and count what arrived."""
    cloud, names = embedded.cloud, [f"{prefix}-{count}-{i:04}" for i in range(count)]
    with tempfile.TemporaryDirectory() as folder:
        tell(f"{count} robots: registering")
        bundles = {name: str(robots.add(cloud, name, out=Path(folder)).folder) for name in names}
        tell(f"{count} robots: connecting")
        load = Load(bundles, cloud.namespace, cloud.mqtt_endpoint, cloud.mqtt_port, seconds, rate_hz)
        emulator = embedded.emulator.pid
        file = Path(folder) / "load.json"
        file.write_text(json.dumps(asdict(load)))
        with _generator(file) as generator:
            pid, began = next(said["pid"] for said in generator if "pid" in said), time.monotonic()
            tell(f"{count} robots: driving")
            before = after = _usage(pid, emulator)
            took_s, sent = 1.0, None
            with _summary_age(cloud, names[0]) as behind:
                while sent is None:
                    sent = next(generator).get("sent")
                    # The generator's memory disappears with the process, which ends when all is sent.
                    if sent is None:
                        after, took_s = _usage(pid, emulator), time.monotonic() - began
    batches = sent["batches"]
    began = time.monotonic()
    tell(f"{count} robots: waiting for the summaries")
    in_summary = _summarized(cloud, batches, rate_hz)
    done = _usage(pid, emulator)
    catch_up_s = time.monotonic() - began
    tell(f"{count} robots: counting the batches")
    arrived = [_stored(cloud, name, sent["sent_ms"][name]) for name in names]
    return Fleet(
        robots=count,
        rate_hz=rate_hz,
        seconds=seconds,
        batches_sent=sum(batches.values()),
        batches_stored=sum(each.batches for each in arrived),
        batches_lost=sum(each.missing for each in arrived),
        samples_sent=sum(batches.values()) * rate_hz,
        samples_summarized=in_summary,
        topics_out_of_order=sum(not each.ordered for each in arrived),
        resent=sent["resent"],
        lost_sessions=sent["lost_sessions"],
        generator_late_ms_max=sent["late_ms_max"],
        delay_ms=Spread.of([ms for each in arrived for ms in each.delays_ms]),
        ack_ms=Spread.of(sent["ack_ms"]),
        summary_behind_s=Spread.of(behind),
        catch_up_s=round(catch_up_s, 1),
        cpu_s=round(sum(done[name].cpu_s - before[name].cpu_s for name in OURS), 2),
        cpu_percent={
            name: round((after[name].cpu_s - before[name].cpu_s) / took_s * 100, 1) for name in before
        },
        rss_mb={name: round(after[name].rss_mb, 1) for name in after},
    )


@contextmanager
def _generator(load: Path) -> Iterator[Iterator[dict[str, Any]]]:
    """Run the process that drives the robots; yield its output, a dictionary for each line."""
    command = [sys.executable, "-m", "bench.load.fleet.generator", str(load)]

    def said() -> Iterator[dict[str, Any]]:
        yield from map(json.loads, process.stdout or ())
        raise InstrumentError(f"the load generator ended with status {process.wait()}")

    with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True) as process:
        try:
            yield said()
        finally:
            process.terminate()


def _usage(generator: int, emulator: int) -> dict[str, machine.Usage]:
    return {
        "load generator": machine.usage_of(generator),
        **dict(zip(OURS, (machine.usage_of(emulator), machine.usage_below(emulator)), strict=True)),
    }


@contextmanager
def _summary_age(cloud: Cloud, robot: str) -> Iterator[list[float]]:
    """Collect the age of the newest summarised second of a robot, in seconds, once a second."""
    seen: list[float] = []
    over = threading.Event()

    def watch() -> None:
        while not over.wait(1.0):
            try:
                newest = _ends(cloud, robot)[1:]
            except (BotoCoreError, ClientError):
                # An overloaded cloud answers late or not at all; only the stored items count.
                continue
            # A second is over when the next one begins.
            seen.extend(round(time.time() - second - 1, 3) for second in newest)

    watcher = threading.Thread(target=watch, daemon=True)
    watcher.start()
    try:
        yield seen
    finally:
        over.set()
        watcher.join()


class _Stored:
    """A robot's batches in the table, compared with those that it sent.

    ``ordered`` is True if they arrived and are stored in the order of their numbers.
    """

    def __init__(self, items: Sequence[dict[str, Any]], sent_ms: Sequence[int]) -> None:
        seqs = [batch_id(item[BATCH]).seq for item in items]
        received = [int(item[RECEIVED_MS]) for item in items]
        self.batches, self.missing = len(items), len(set(range(len(sent_ms))) - set(seqs))
        self.ordered = seqs == sorted(seqs) and received == sorted(received)
        self.delays_ms = [float(ms - sent_ms[seq]) for seq, ms in zip(seqs, received, strict=True)]


def _stored(cloud: Cloud, robot: str, sent_ms: Sequence[int]) -> _Stored:
    return _Stored(list(headers(cloud, robot, VESC_STREAM)), sent_ms)


def _summarized(cloud: Cloud, batches: dict[str, int], rate_hz: int) -> int:
    """Count the samples in the summaries of all robots, after all have arrived or no more come.

    It waits for one robot after the other, since all lag equally.
    """
    total, since = 0, time.monotonic()
    for name, seconds in batches.items():
        counted, looked_at = 0, None
        while True:
            # Counting is expensive: count only when the summaries reach the last second that was sent.
            ends = _ends(cloud, name)
            over = time.monotonic() - since > _CATCH_UP_S
            if over or (ends and ends[1] - ends[0] + 1 >= seconds):
                counted = audit.samples_summarized(cloud, name, VESC_STREAM)
            if counted >= seconds * rate_hz or over:
                break
            if looked_at != (counted, ends):
                since = since if looked_at is None else time.monotonic()
            looked_at = counted, ends
            threading.Event().wait(0.5)
        total += counted
    return total


def _ends(cloud: Cloud, robot: str) -> list[int]:
    """Return the first and the last summarised second of a robot; empty if it has none."""
    table, topic = summary_table(cloud), topic_of(cloud, robot, VESC_STREAM)
    ends = (table.first(topic, newest=newest, attributes=(SECOND,)) for newest in (False, True))
    return [int(item[SECOND]["N"]) for item in ends if item is not None]
