"""`make bench-fleet`: how many robots the embedded cloud carries, and what that costs.

    python -m bench.fleet [--robots 200] [--seconds 300] [--json FILE]

Every robot has a certificate and a session of its own and sends a batch of 50 samples a second, through
the record rule into the telemetry table, whose stream Lambda 2 summarises. What was stored and summarised
is counted in the tables, batch by batch, against what was sent; exit status 1 if a sample is missing.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

from boto3.dynamodb.types import TypeDeserializer
from botocore.exceptions import BotoCoreError, ClientError
from rich.console import Console
from rich.progress import Progress
from rich.table import Table

from bench import usage
from bench.fleet_load import SAMPLES as BATCH_SAMPLES
from bench.fleet_load import Load
from contract import RECEIVED_MS, RECORD, SAMPLES, SECOND, T_US, TOPIC, VESC_STREAM, build_topic
from local.cloud import EmbeddedCloud
from local.deployment import ROOT
from local.errors import LocalError
from local.figures import Spread
from station import robots
from station.cloud import Cloud

# So long without any news, and no more comes.
_CATCH_UP_S = 120.0
# How often progress is a line, where it cannot be a bar.
_SAY_S = 5.0
_deserialize = TypeDeserializer().deserialize


@dataclass(frozen=True)
class Fleet:
    """Of one run: what was sent, what arrived, how late, and what the machine spent on it.

    ``delay_ms`` is from the robot's publish to the rule's ``received_ms``; ``ack_ms`` to the broker's
    acknowledgement; ``summary_behind_s`` is the age of the newest summarised second of one robot, seen
    once a second; ``catch_up_s`` how long Lambda 2 went on after the last batch. CPU is in percent of
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
        """Sent, and not in the telemetry table or not in the summary."""
        stored = self.samples_sent - self.batches_lost * BATCH_SAMPLES
        return self.samples_sent - min(stored, self.samples_summarized)

    @property
    def good(self) -> bool:
        """Nothing lost, nothing twice, every topic in order."""
        return (
            self.samples_sent == self.samples_summarized
            and not self.batches_lost
            and not self.topics_out_of_order
            and self.batches_stored == self.batches_sent
        )

    def as_json(self) -> dict[str, Any]:
        """The figures, and what they come to."""
        return {**asdict(self), "samples_lost": self.samples_lost, "good": self.good}


Tell = Callable[[float, str], None]


def measure(embedded: EmbeddedCloud, count: int, seconds: int, tell: Tell, *, prefix: str = "bench") -> Fleet:
    """Register ``count`` robots, drive them, count what arrived. ``tell`` hears the share done, and of
    what."""
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
                    # The generator's memory is gone with the process, which ends when all is sent.
                    after, took_s = _usage(pid, emulator), time.monotonic() - began
                    tell(said["second"] / seconds, "driving")
        sent = said["sent"]
    batches = sent["batches"]
    expected = sum(batches.values()) * BATCH_SAMPLES
    began = time.monotonic()
    summarized = _summarized(cloud, {name: batches[name] * BATCH_SAMPLES for name in names}, tell)
    catch_up_s = time.monotonic() - began
    stored = []
    for i, name in enumerate(names):
        stored.append(_stored(cloud, name, sent["sent_ms"][name]))
        tell((i + 1) / count, "counting the batches")
    return Fleet(
        robots=count,
        seconds=seconds,
        batches_sent=expected // BATCH_SAMPLES,
        batches_stored=sum(each.batches for each in stored),
        batches_lost=sum(each.missing for each in stored),
        samples_sent=expected,
        samples_summarized=summarized,
        topics_out_of_order=sum(not each.ordered for each in stored),
        resent=sent["resent"],
        lost_sessions=sent["lost_sessions"],
        generator_late_ms_max=sent["late_ms_max"],
        delay_ms=Spread.of([ms for each in stored for ms in each.delays_ms]),
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
    """What the process that drives the robots says, a dictionary a line."""
    command = [sys.executable, "-m", "bench.fleet_load"]
    with subprocess.Popen(
        command, cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as process:
        try:
            if process.stdin is None or process.stdout is None:
                raise LocalError("the load generator has no pipes")
            process.stdin.write(json.dumps(asdict(load)) + "\n")
            process.stdin.flush()
            lines = process.stdout

            def said() -> Iterator[dict[str, Any]]:
                for line in lines:
                    yield json.loads(line)
                raise LocalError(f"the load generator ended with status {process.wait()}")

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
    """How old the newest summarised second of a robot is, in seconds, once a second meanwhile."""
    seen: list[float] = []
    over = threading.Event()

    def watch() -> None:
        while not over.wait(1.0):
            try:
                answer = cloud.client("dynamodb").query(
                    **_of_topic(cloud, "SummaryTable", robot, SECOND), ScanIndexForward=False, Limit=1
                )
            except (BotoCoreError, ClientError):
                # A cloud that is overloaded answers late, or not; what it stores is what counts.
                continue
            # A second is over when the next one begins.
            seen.extend(round(time.time() - int(item[SECOND]["N"]) - 1, 3) for item in answer["Items"])

    watcher = threading.Thread(target=watch, daemon=True)
    watcher.start()
    try:
        yield seen
    finally:
        over.set()
        watcher.join()


def _summarized(cloud: Cloud, expected: dict[str, int], tell: Tell) -> int:
    """The samples in the summary of all robots, once they are all there or no more come.

    One robot is asked for after the other: all are equally far behind, so the one that is waited for tells.
    """
    total, since = 0, time.monotonic()
    for name, samples in expected.items():
        counted, looked_at = 0, None
        while True:
            # To count is dear: not before its seconds go as far as what was sent.
            spanned = _spanned(cloud, name)
            if spanned * BATCH_SAMPLES >= samples:
                counted = sum(int(item[SAMPLES]) for item in _items(cloud, "SummaryTable", name, SAMPLES))
            if looked_at not in {None, (counted, spanned)}:
                since = time.monotonic()
            looked_at = counted, spanned
            tell(spanned * BATCH_SAMPLES / samples, "waiting for the summaries")
            if counted >= samples:
                break
            if time.monotonic() - since > _CATCH_UP_S:
                counted = sum(int(item[SAMPLES]) for item in _items(cloud, "SummaryTable", name, SAMPLES))
                break
            threading.Event().wait(0.5)
        total += counted
    return total


def _spanned(cloud: Cloud, robot: str) -> int:
    """The seconds from a robot's first to its last summary."""
    query = cloud.client("dynamodb").query
    of_topic = _of_topic(cloud, "SummaryTable", robot, SECOND)
    ends = [
        int(item[SECOND]["N"])
        for forward in (True, False)
        for item in query(**of_topic, ScanIndexForward=forward, Limit=1)["Items"]
    ]
    return ends[1] - ends[0] + 1 if ends else 0


@dataclass(frozen=True)
class _Stored:
    batches: int
    missing: int
    ordered: bool
    delays_ms: list[float]


def _stored(cloud: Cloud, robot: str, sent_ms: list[int]) -> _Stored:
    """A robot's items against what it sent: which are there, and in the order of their numbers."""
    items = list(_items(cloud, "TelemetryTable", robot, "seq", T_US, RECEIVED_MS))
    seqs = [int(item["seq"]) for item in items]
    received = [int(item[RECEIVED_MS]) for item in items]
    return _Stored(
        batches=len(items),
        missing=len(set(range(len(sent_ms))) - set(seqs)),
        ordered=seqs == sorted(seqs) and received == sorted(received),
        delays_ms=[float(ms - sent_ms[seq]) for seq, ms in zip(seqs, received, strict=True)],
    )


def _items(cloud: Cloud, table: str, robot: str, *fields: str) -> Iterator[dict[str, Any]]:
    pages = cloud.client("dynamodb").get_paginator("query")
    for page in pages.paginate(**_of_topic(cloud, table, robot, *fields)):
        for item in page["Items"]:
            yield {name: _deserialize(value) for name, value in item.items()}


def _of_topic(cloud: Cloud, table: str, robot: str, *fields: str) -> dict[str, Any]:
    topic = build_topic(RECORD, robot, VESC_STREAM, cloud.namespace)
    return {
        "TableName": cloud.output("storage", table),
        "KeyConditionExpression": "#topic = :topic",
        "ExpressionAttributeNames": {"#topic": TOPIC, **{f"#{name}": name for name in fields}},
        "ExpressionAttributeValues": {":topic": {"S": topic}},
        "ProjectionExpression": ", ".join(f"#{name}" for name in fields),
    }


def as_table(fleet: Fleet) -> Table:
    """The figures for a person."""
    table = Table(title=f"{fleet.robots} robots, {fleet.seconds} s", title_justify="left", title_style="bold")
    table.add_column("figure")
    table.add_column("", justify="right")
    for name, value in (
        ("batches sent", f"{fleet.batches_sent:,}"),
        ("batches stored", f"{fleet.batches_stored:,}"),
        ("samples sent", f"{fleet.samples_sent:,}"),
        ("samples summarised", f"{fleet.samples_summarized:,}"),
        ("samples lost", f"{fleet.samples_lost:,}"),
        ("topics out of order", str(fleet.topics_out_of_order)),
        ("sent again, sessions lost", f"{fleet.resent}, {fleet.lost_sessions}"),
        ("robot to rule", str(fleet.delay_ms)),
        ("robot to acknowledgement", str(fleet.ack_ms)),
        ("summary behind by", f"{fleet.summary_behind_s.p50} s (p95 {fleet.summary_behind_s.p95})"),
        ("Lambda 2 done after the last batch", f"{fleet.catch_up_s} s"),
        *((f"CPU, {name}", f"{percent} % of a core") for name, percent in fleet.cpu_percent.items()),
        *((f"memory, {name}", f"{mb} MB") for name, mb in fleet.rss_mb.items()),
    ):
        table.add_row(name, value)
    return table


@contextmanager
def progress(console: Console) -> Iterator[Tell]:
    """A bar for each thing that `measure` tells of; without a terminal, a line every few seconds."""
    if not console.is_terminal:
        yield _lines(console)
        return
    with Progress(console=console, transient=True) as bars:
        tasks: dict[str, Any] = {}

        def tell(share: float, what: str) -> None:
            if what not in tasks:
                tasks[what] = bars.add_task(what, total=1.0)
            bars.update(tasks[what], completed=share)

        yield tell


def _lines(console: Console) -> Tell:
    last = ("", 0.0)

    def tell(share: float, what: str) -> None:
        nonlocal last
        if what != last[0] or time.monotonic() - last[1] >= _SAY_S:
            last = (what, time.monotonic())
            console.print(f"  {what}: {share:.0%}", style="dim")

    return tell


def main() -> None:
    """Measure and print; exit status 1 if anything is missing or out of order."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--robots", type=int, nargs="+", default=[200], help="one run for each number")
    parser.add_argument("--seconds", type=int, default=300, help="how long they drive")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures as JSON too")
    options = parser.parse_args()
    console, runs = Console(), []
    try:
        with (
            tempfile.TemporaryDirectory() as folder,
            EmbeddedCloud(
                Path(folder) / "cloud", progress=lambda step: console.print(f"  {step}", style="dim")
            ) as embedded,
        ):
            for count in options.robots:
                with progress(console) as tell:
                    runs.append(measure(embedded, count, options.seconds, tell))
                console.print(as_table(runs[-1]))
    except LocalError as error:
        sys.exit(f"bench-fleet: {error}")
    if options.json:
        report = {
            "at": datetime.now(timezone.utc).isoformat(timespec="seconds"),
            "machine": {"cores": os.cpu_count(), "python": platform.python_version()},
            "load_1min": os.getloadavg()[0],
            "runs": [run.as_json() for run in runs],
        }
        options.json.write_text(json.dumps(report, indent=2) + "\n")
    sys.exit(0 if all(run.good for run in runs) else 1)


if __name__ == "__main__":
    main()
