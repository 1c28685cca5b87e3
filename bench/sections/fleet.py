"""Many robots at once: what was sent, what arrived and how late, and the cost of it.

Every robot has a certificate and a session of its own and sends a batch of 50 samples a second, through
the record rule into the telemetry table, whose stream Lambda 2 summarises. What was stored and summarised
is counted in the tables, batch by batch, against what was sent. With LIMIT the number of robots grows until
summaries are late. Other programs on the machine lower it; the processor time for a batch hardly depends on
them.
"""

from __future__ import annotations

import json
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from botocore.exceptions import BotoCoreError, ClientError

from bench import plots
from bench.load.counting import process, summarized_ends
from bench.load.generator import Load
from bench.report import Report, Section
from bench.sections import Declared, Option, numbers, yes
from iort_contract.catalog.vesc import VESC_STREAM
from iort_contract.messages.batch import batch_id
from iort_contract.tables import BATCH, RECEIVED_MS
from iort_station.cloud import Cloud
from iort_station.fleet import robots
from iort_station.operations import audit
from local.cloud import EmbeddedCloud
from local.figures import Spread
from testkit import machine
from testkit.command import Table
from testkit.target import Say, Target
from testkit.waiting import InstrumentError

# Summaries that are later are late.
BEHIND_S = 10.0
# After so long without a change no more summaries come.
_CATCH_UP_S = 120.0
# The processes that a deployment consists of here.
OURS = ("emulator", "Lambda workers")
# Seconds that each fleet of the section on scale drives; a large one makes as many batches in less time.
FLEETS = {1: 10, 10: 10, 100: 10, 500: 4}


@dataclass(frozen=True)
class Fleet:
    """One run: what was sent, what arrived and how late, and the cost in processor time and memory.

    ``delay_ms`` is from the robot's publish to the rule's ``received_ms``; ``ack_ms`` to the broker's
    acknowledgement; ``summary_behind_s`` is the age of the newest summarised second of one robot, sampled
    once a second; ``catch_up_s`` is how long Lambda 2 went on after the last batch. CPU is in percent of
    one core while the fleet drives, and memory in MB at its end; ``cpu_s`` is the emulator's and the
    functions' until the last summary.
    """

    robots: int
    rate_hz: int
    seconds: int
    batches_sent: int
    batches_stored: int
    batches_lost: int
    samples_summarized: int
    topics_out_of_order: int
    resent: int
    lost_sessions: int
    delay_ms: Spread
    ack_ms: Spread
    summary_behind_s: Spread
    catch_up_s: float
    cpu_s: float
    cpu_percent: dict[str, float]
    rss_mb: dict[str, float]

    @property
    def cpu_ms_a_batch(self) -> float:
        """Processor time of emulator and functions for a batch, until every summary was there."""
        return round(self.cpu_s / max(1, self.batches_sent) * 1000, 2)

    @property
    def samples_sent(self) -> int:
        """In all batches."""
        return self.batches_sent * self.rate_hz

    @property
    def samples_lost(self) -> int:
        """Samples that were sent and are missing in the telemetry table or in the summary."""
        stored = self.samples_sent - self.batches_lost * self.rate_hz
        return self.samples_sent - min(stored, self.samples_summarized)

    @property
    def good(self) -> bool:
        """True if nothing is lost or stored twice and every topic is in order."""
        whole = self.samples_sent == self.samples_summarized and self.batches_stored == self.batches_sent
        return whole and not self.batches_lost and not self.topics_out_of_order

    @property
    def keeps_up(self) -> bool:
        """Whether nothing is lost, and summaries are at most `BEHIND_S` behind."""
        return self.good and self.catch_up_s <= BEHIND_S and (self.summary_behind_s.p95 or 0) <= BEHIND_S

    def as_json(self) -> dict[str, Any]:
        """Return the figures with the derived ones."""
        derived = ("samples_sent", "samples_lost", "good", "keeps_up", "cpu_ms_a_batch")
        return {**asdict(self), **{name: getattr(self, name) for name in derived}}


def table(runs: Sequence[Fleet]) -> Table:
    """Return the figures, with a column for each run."""
    figures: dict[str, Callable[[Fleet], object]] = {
        "seconds": lambda run: run.seconds,
        "batches sent": lambda run: f"{run.batches_sent:,}",
        "batches stored": lambda run: f"{run.batches_stored:,}",
        "samples sent": lambda run: f"{run.samples_sent:,}",
        "samples summarised": lambda run: f"{run.samples_summarized:,}",
        "samples lost": lambda run: f"{run.samples_lost:,}",
        "out of order": lambda run: run.topics_out_of_order,
        "sent again, sessions lost": lambda run: f"{run.resent}, {run.lost_sessions}",
        "robot to rule": lambda run: run.delay_ms,
        "robot to acknowledgement": lambda run: run.ack_ms,
        "summary behind by": lambda run: f"{run.summary_behind_s.p50} s (p95 {run.summary_behind_s.p95})",
        "Lambda 2 done after the last batch": lambda run: f"{run.catch_up_s:.1f} s",
        "CPU for a batch": lambda run: f"{run.cpu_ms_a_batch:.2f} ms",
    }
    rows = [[name, *(str(figure(run)) for run in runs)] for name, figure in figures.items()]
    for part in runs[0].cpu_percent:
        rows.append([f"CPU, {part}", *(f"{run.cpu_percent[part]:.0f} %" for run in runs)])
        rows.append([f"memory, {part}", *(f"{run.rss_mb[part]:.0f} MB" for run in runs)])
    head = ["", *(f"{run.robots} robot{'s' * (run.robots > 1)}" for run in runs)]
    title = f"Robots with a certificate and a session each, a batch of {runs[0].rate_hz} samples a second"
    return Table(title, head, rows)


def limits(runs: Sequence[Fleet]) -> Table:
    """Return a row for each run of a search of the limit."""
    rows = [
        [
            f"{run.robots} at {run.rate_hz} Hz",
            "yes" if run.keeps_up else "no",
            f"{run.summary_behind_s.p95} s",
            f"{run.catch_up_s:.1f} s",
            f"{run.cpu_ms_a_batch:.2f} ms",
        ]
        for run in sorted(runs, key=lambda run: (run.rate_hz, run.robots))
    ]
    head = ["robots", "keeps up", "summary behind by, p95", "done after the last batch", "CPU for a batch"]
    return Table(f"Robots whose summaries are at most {BEHIND_S:.0f} s behind", head, rows)


def measure(
    embedded: EmbeddedCloud, count: int, seconds: int, say: Say, *, rate_hz: int = 50, prefix: str = "bench"
) -> Fleet:
    """Register ``count`` robots, drive them, and count what arrived."""
    cloud, names = embedded.cloud, [f"{prefix}-{count}-{i:04}" for i in range(count)]
    emulator = embedded.emulator.pid

    def usage(generator: int) -> dict[str, machine.Usage]:
        parts = (machine.usage_of(generator), machine.usage_of(emulator), machine.usage_below(emulator))
        return dict(zip(("load generator", *OURS), parts, strict=True))

    with tempfile.TemporaryDirectory() as folder:
        say(f"{count} robots: registering")
        bundles = {name: str(robots.add(cloud, name, out=Path(folder)).folder) for name in names}
        say(f"{count} robots: connecting")
        load = Load(bundles, cloud.namespace, cloud.mqtt_endpoint, cloud.mqtt_port, seconds, rate_hz)
        file = Path(folder) / "load.json"
        file.write_text(json.dumps(asdict(load)))
        with process("bench.load.generator", str(file)) as generator:
            pid, began = next(said["pid"] for said in generator if "pid" in said), time.monotonic()
            say(f"{count} robots: driving")
            before = after = usage(pid)
            took_s, sent = 1.0, None
            with _summary_age(cloud, names[0]) as behind:
                while sent is None:
                    sent = next(generator).get("sent")
                    # The generator's memory disappears with the process, which ends when all is sent.
                    if sent is None:
                        after, took_s = usage(pid), time.monotonic() - began
    batches: dict[str, int] = {name: len(times) for name, times in sent["sent_ms"].items()}
    began = time.monotonic()
    say(f"{count} robots: waiting for the summaries")
    summarized = _summarized(cloud, batches, rate_hz)
    done, catch_up_s = usage(pid), time.monotonic() - began
    say(f"{count} robots: counting the batches")
    arrived = [_Stored(cloud, name, sent["sent_ms"][name]) for name in names]
    return Fleet(
        robots=count,
        rate_hz=rate_hz,
        seconds=seconds,
        batches_sent=sum(batches.values()),
        batches_stored=sum(each.batches for each in arrived),
        batches_lost=sum(each.missing for each in arrived),
        samples_summarized=summarized,
        topics_out_of_order=sum(not each.ordered for each in arrived),
        resent=sent["resent"],
        lost_sessions=sent["lost_sessions"],
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
def _summary_age(cloud: Cloud, robot: str) -> Iterator[list[float]]:
    """Collect the age of the newest summarised second of a robot, in seconds, once a second."""
    seen: list[float] = []
    over = threading.Event()

    def watch() -> None:
        while not over.wait(1.0):
            try:
                newest = summarized_ends(cloud, robot)[1:]
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

    def __init__(self, cloud: Cloud, robot: str, sent_ms: Sequence[int]) -> None:
        items = list(audit.headers(cloud, robot, VESC_STREAM))
        seqs = [batch_id(item[BATCH]).seq for item in items]
        received = [int(item[RECEIVED_MS]) for item in items]
        self.batches, self.missing = len(items), len(set(range(len(sent_ms))) - set(seqs))
        self.ordered = seqs == sorted(seqs) and received == sorted(received)
        self.delays_ms = [float(ms - sent_ms[seq]) for seq, ms in zip(seqs, received, strict=True)]


def _summarized(cloud: Cloud, batches: dict[str, int], rate_hz: int) -> int:
    """Count the samples in the summaries of all robots, after all have arrived or no more come.

    It waits for one robot after the other, since all lag equally.
    """
    total, since = 0, time.monotonic()
    for name, seconds in batches.items():
        counted, looked_at = 0, None
        while True:
            # Counting is expensive: count only when the summaries reach the last second that was sent.
            ends = summarized_ends(cloud, name)
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


def drive_fleets(
    target: Target, say: Say, *, robots: list[int], seconds: int, rate: int, limit: bool
) -> Section:
    """Drive a fleet of each number, or look for the largest one that keeps up."""
    section, runs, embedded = Section("fleet", "Many robots at once"), list[Fleet](), target.embedded
    if embedded is None:
        raise InstrumentError("the robots of a fleet drive on the embedded cloud alone")

    def drive(count: int) -> Fleet:
        prefix = f"bench-{len(runs)}"
        runs.append(measure(embedded, count, seconds, say, rate_hz=rate, prefix=prefix))
        return runs[-1]

    if limit:
        look_for(drive, robots[0])
    else:
        for count in robots:
            drive(count)
    section.tables.append(limits(runs) if limit else table(runs))
    _count_lost(section, [run for run in runs if run.keeps_up or not limit])
    disordered = sum(not run.good for run in runs if run.keeps_up or not limit)
    section.ratio("fleets with a batch lost, doubled or out of order", disordered, 0, unit="fleets")
    section.raw = {"runs": [run.as_json() for run in runs]}
    return section


def _count_lost(section: Section, runs: Sequence[Fleet]) -> None:
    section.ratio("samples lost in all fleets", sum(run.samples_lost for run in runs), 0, unit="samples")


def look_for(drive: Callable[[int], Fleet], robots: int) -> int:
    """The largest number of robots that keeps up, to a tenth; ``robots`` is where the search begins."""
    keeps, late = 0, 0
    while not late or late - keeps > max(1, late // 10):
        if drive(robots).keeps_up:
            keeps = robots
        else:
            late = robots
        robots = (keeps + late) // 2 if late else keeps * 2
    return keeps


def run(target: Target, say: Say) -> Section:
    """Drive each fleet for some seconds: a batch of 50 samples a second and robot."""
    section, embedded = Section("scale", "Scale"), target.embedded
    if embedded is None:
        section.notes.append(
            "Not run on AWS: 500 robots would be registered in your account. What the quotas allow is in the "
            "section on cost."
        )
        return section
    runs = [measure(embedded, count, s, say, prefix="bench-scale") for count, s in FLEETS.items()]
    section.tables.append(table(runs))
    _count_lost(section, runs)
    last = runs[-1]
    busiest = max(last.cpu_percent, key=lambda part: last.cpu_percent[part])
    section.notes.append(
        f"With {last.robots} robots the part that works most is the {busiest}, at "
        f"{last.cpu_percent[busiest]:.0f} % of a core; Lambda 2 was done {last.catch_up_s:.0f} s after the "
        "last batch. All share this machine's cores, the robots as well."
    )
    counts = [float(run.robots) for run in runs]
    cpu = {part: [run.cpu_percent[part] for run in runs] for part in last.cpu_percent}
    title = "CPU by part, in percent of a core"
    section.plot("scale-cpu", title, plots.lines(counts, cpu, x_label="robots", y_label="%"))
    delays = {
        "robot to rule": [run.delay_ms.p95 or 0.0 for run in runs],
        "robot to acknowledgement": [run.ack_ms.p95 or 0.0 for run in runs],
    }
    title = "Robot to rule and to acknowledgement, p95"
    section.plot("scale-delay", title, plots.lines(counts, delays, x_label="robots", y_label="ms"))
    section.raw = {"runs": [run.as_json() for run in runs]}
    return section


SCALE = Declared("1, 10, 100 and 500 robots on the embedded cloud", run)
SECTION = Declared(
    "many robots on the embedded cloud",
    drive_fleets,
    (
        Option("ROBOTS", numbers, [200], "one run for each number"),
        Option("SECONDS", int, 300, "how long they drive"),
        Option("RATE", int, 50, "samples a second of each"),
        Option("LIMIT", yes, False, "look for the largest number that keeps up, from the first of ROBOTS on"),
    ),
    Report("fleet", "Many robots at once", "make bench ONLY=fleet"),
)
