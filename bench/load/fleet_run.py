"""One run of a fleet: every robot registered, driven by a process of its own, and counted."""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from botocore.exceptions import BotoCoreError, ClientError

from bench import ROOT
from bench.errors import BenchError
from bench.load.fleet_arrivals import Tell, stored, summarized
from bench.load.fleet_load import SAMPLES as BATCH_SAMPLES
from bench.load.fleet_load import Load
from bench.meters import usage
from iort_contract.catalog.vesc import VESC_STREAM
from iort_contract.tables import SECOND
from iort_station.cloud import Cloud
from iort_station.data.batches import summary_table, topic_of
from iort_station.fleet import robots
from local.cloud import EmbeddedCloud
from local.figures import Spread


@dataclass(frozen=True)
class Fleet:
    """One run: what was sent, what arrived and how late, and the cost in processor time and memory.

    ``delay_ms`` is from the robot's publish to the rule's ``received_ms``; ``ack_ms`` to the broker's
    acknowledgement; ``summary_behind_s`` is the age of the newest summarised second of one robot, sampled
    once a second; ``catch_up_s`` is how long Lambda 2 went on after the last batch. CPU is in percent of
    one core while the fleet drives, memory in MB at its end.
    """

    robots: int
    seconds: int
    batches_sent: int
    batches_stored: int
    batches_lost: int
    samples_sent: int
    samples_summarized: int
    topics_out_of_order: int
    resent: int
    lost_sessions: int
    generator_late_ms_max: float
    delay_ms: Spread
    ack_ms: Spread
    summary_behind_s: Spread
    catch_up_s: float
    cpu_percent: dict[str, float]
    rss_mb: dict[str, float]

    @property
    def samples_lost(self) -> int:
        """Samples that were sent and are missing in the telemetry table or in the summary."""
        stored = self.samples_sent - self.batches_lost * BATCH_SAMPLES
        return self.samples_sent - min(stored, self.samples_summarized)

    @property
    def good(self) -> bool:
        """True if nothing is lost or stored twice and every topic is in order."""
        return (
            self.samples_sent == self.samples_summarized
            and not self.batches_lost
            and not self.topics_out_of_order
            and self.batches_stored == self.batches_sent
        )

    def as_json(self) -> dict[str, Any]:
        """Return the figures with the derived ones."""
        return {**asdict(self), "samples_lost": self.samples_lost, "good": self.good}


def measure(embedded: EmbeddedCloud, count: int, seconds: int, tell: Tell, *, prefix: str = "bench") -> Fleet:
    """Register ``count`` robots, drive them, and count what arrived; ``tell`` gets the progress."""
    cloud, names = embedded.cloud, [f"{prefix}-{count}-{i:04}" for i in range(count)]
    with tempfile.TemporaryDirectory() as folder:
        bundles = {}
        for i, name in enumerate(names):
            bundles[name] = str(robots.add(cloud, name, out=Path(folder)).folder)
            tell((i + 1) / count, "registering robots")
        load = Load(bundles, cloud.namespace, cloud.mqtt_endpoint, cloud.mqtt_port, seconds)
        emulator = embedded.emulator.pid
        with _generator(load) as generator:
            for said in generator:
                if "pid" in said:
                    break
                tell(said["connected"] / count, "connecting")
            pid, began = said["pid"], time.monotonic()
            before = _usage(pid, emulator)
            with _summary_age(cloud, names[0]) as behind:
                after, took_s = before, 1.0
                for said in generator:
                    if "sent" in said:
                        break
                    # The generator's memory disappears with the process, which ends when all is sent.
                    after, took_s = _usage(pid, emulator), time.monotonic() - began
                    tell(said["second"] / seconds, "driving")
        sent = said["sent"]
    batches = sent["batches"]
    expected = sum(batches.values()) * BATCH_SAMPLES
    began = time.monotonic()
    in_summary = summarized(cloud, {name: batches[name] * BATCH_SAMPLES for name in names}, tell)
    catch_up_s = time.monotonic() - began
    arrived = []
    for i, name in enumerate(names):
        arrived.append(stored(cloud, name, sent["sent_ms"][name]))
        tell((i + 1) / count, "counting the batches")
    return Fleet(
        robots=count,
        seconds=seconds,
        batches_sent=expected // BATCH_SAMPLES,
        batches_stored=sum(each.batches for each in arrived),
        batches_lost=sum(each.missing for each in arrived),
        samples_sent=expected,
        samples_summarized=in_summary,
        topics_out_of_order=sum(not each.ordered for each in arrived),
        resent=sent["resent"],
        lost_sessions=sent["lost_sessions"],
        generator_late_ms_max=sent["late_ms_max"],
        delay_ms=Spread.of([ms for each in arrived for ms in each.delays_ms]),
        ack_ms=Spread.of(sent["ack_ms"]),
        summary_behind_s=Spread.of(behind),
        catch_up_s=round(catch_up_s, 1),
        cpu_percent={
            name: round((after[name].cpu_s - before[name].cpu_s) / took_s * 100, 1) for name in before
        },
        rss_mb={name: round(after[name].rss_mb, 1) for name in after},
    )


@contextmanager
def _generator(load: Load) -> Iterator[Iterator[dict[str, Any]]]:
    """Run the process that drives the robots; yield its output, a dictionary for each line."""
    command = [sys.executable, "-m", "bench.load.fleet_load"]
    with subprocess.Popen(
        command, cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as process:
        try:
            if process.stdin is None or process.stdout is None:
                raise BenchError("the load generator has no pipes")
            process.stdin.write(json.dumps(asdict(load)) + "\n")
            process.stdin.flush()
            lines = process.stdout

            def said() -> Iterator[dict[str, Any]]:
                for line in lines:
                    yield json.loads(line)
                raise BenchError(f"the load generator ended with status {process.wait()}")

            yield said()
        finally:
            process.terminate()


def _usage(generator: int, emulator: int) -> dict[str, usage.Usage]:
    return {
        "load generator": usage.of(generator),
        "emulator": usage.of(emulator),
        "Lambda workers": usage.below(emulator),
    }


@contextmanager
def _summary_age(cloud: Cloud, robot: str) -> Iterator[list[float]]:
    """Collect the age of the newest summarised second of a robot, in seconds, once a second."""
    seen: list[float] = []
    over = threading.Event()
    table, topic = summary_table(cloud), topic_of(cloud, robot, VESC_STREAM)

    def watch() -> None:
        while not over.wait(1.0):
            try:
                newest = table.first(topic, newest=True, attributes=(SECOND,))
            except (BotoCoreError, ClientError):
                # An overloaded cloud answers late or not at all; only the stored items count.
                continue
            # A second is over when the next one begins.
            if newest is not None:
                seen.append(round(time.time() - int(newest[SECOND]["N"]) - 1, 3))

    watcher = threading.Thread(target=watch, daemon=True)
    watcher.start()
    try:
        yield seen
    finally:
        over.set()
        watcher.join()
