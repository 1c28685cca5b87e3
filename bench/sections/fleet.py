"""Many robots at once: what was sent, what arrived and how late, and the cost of it.

Every robot has a certificate and a session of its own and sends a batch of samples a second, through the
record rule into the telemetry table, whose stream Lambda 2 summarises. What was stored and summarised is
counted in the tables, batch by batch, against what was sent.
"""

from __future__ import annotations

import json
import tempfile
import threading
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from bench.load.counting import process, summarized_ends
from bench.load.generator import Load
from bench.report import Section
from bench.sections import Declared, Option, numbers
from iort_contract.catalog.vesc import VESC_STREAM
from iort_contract.messages.batch import batch_id
from iort_contract.tables import BATCH, RECEIVED_MS
from iort_station.cloud import Cloud
from iort_station.fleet import robots as registered
from iort_station.operations import audit
from local.cloud import EmbeddedCloud
from local.figures import Spread
from testkit import machine
from testkit.target import Say, Target

# After so long without a change no more summaries come.
_CATCH_UP_S = 120.0


@dataclass(frozen=True)
class Fleet:
    """One run: what was sent, what arrived and how late, and the cost in processor time and memory.

    ``delay_ms`` is from the robot's publish to the rule's ``received_ms``; ``ack_ms`` to the broker's
    acknowledgement; ``catch_up_s`` is how long Lambda 2 went on after the last batch. CPU is in percent of a
    core while the fleet drives, and memory in MB at its end; ``cpu_s`` is the emulator's and the functions'
    until the last summary.
    """

    robots: int
    batches_sent: int
    batches_stored: int
    batches_lost: int
    samples_lost: int
    topics_out_of_order: int
    resent: int
    lost_sessions: int
    delay_ms: Spread
    ack_ms: Spread
    catch_up_s: float
    cpu_s: float
    cpu_percent: dict[str, float]
    rss_mb: dict[str, float]

    @property
    def good(self) -> bool:
        """True if nothing is lost or stored twice and every topic is in order."""
        doubled = self.batches_stored != self.batches_sent
        return not (self.samples_lost or self.batches_lost or doubled or self.topics_out_of_order)

    def figures(self) -> dict[str, str]:
        """Each figure of the table by its name."""
        return {
            "batches sent": f"{self.batches_sent:,}",
            "batches stored": f"{self.batches_stored:,}",
            "samples lost": f"{self.samples_lost:,}",
            "out of order": str(self.topics_out_of_order),
            "sent again, sessions lost": f"{self.resent}, {self.lost_sessions}",
            "robot to rule": str(self.delay_ms),
            "robot to acknowledgement": str(self.ack_ms),
            "Lambda 2 done after the last batch": f"{self.catch_up_s:.1f} s",
            "CPU for a batch": f"{self.cpu_s / max(1, self.batches_sent) * 1000:.2f} ms",
            **{f"CPU, {part}": f"{percent:.0f} %" for part, percent in self.cpu_percent.items()},
            **{f"memory, {part}": f"{mb:.0f} MB" for part, mb in self.rss_mb.items()},
        }


def measure(embedded: EmbeddedCloud, count: int, seconds: int, rate_hz: int, say: Say) -> Fleet:
    """Register ``count`` robots, drive them, and count what arrived."""
    cloud, names = embedded.cloud, [f"bench-fleet-{count}-{i:04}" for i in range(count)]
    emulator = embedded.emulator.pid

    def usage(generator: int) -> dict[str, machine.Usage]:
        return {
            "load generator": machine.usage_of(generator),
            "emulator": machine.usage_of(emulator),
            "Lambda workers": machine.usage_below(emulator),
        }

    with tempfile.TemporaryDirectory() as folder:
        say(f"{count} robots: registering and connecting")
        bundles = {name: str(registered.add(cloud, name, out=Path(folder)).folder) for name in names}
        load = Load(bundles, cloud.namespace, seconds, rate_hz)
        file = Path(folder) / "load.json"
        file.write_text(json.dumps(asdict(load)))
        with process("bench.load.generator", str(file)) as generator:
            pid, began = next(said["pid"] for said in generator if "pid" in said), time.monotonic()
            say(f"{count} robots: driving")
            before = after = usage(pid)
            took_s, sent = 1.0, None
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
    lost, samples = sum(each.missing for each in arrived), sum(batches.values()) * rate_hz
    return Fleet(
        robots=count,
        batches_sent=sum(batches.values()),
        batches_stored=sum(each.batches for each in arrived),
        batches_lost=lost,
        samples_lost=samples - min(samples - lost * rate_hz, summarized),
        topics_out_of_order=sum(not each.ordered for each in arrived),
        resent=sent["resent"],
        lost_sessions=sent["lost_sessions"],
        delay_ms=Spread.of([ms for each in arrived for ms in each.delays_ms]),
        ack_ms=Spread.of(sent["ack_ms"]),
        catch_up_s=round(catch_up_s, 1),
        cpu_s=sum(done[part].cpu_s - before[part].cpu_s for part in ("emulator", "Lambda workers")),
        cpu_percent={part: (after[part].cpu_s - before[part].cpu_s) / took_s * 100 for part in before},
        rss_mb={part: used.rss_mb for part, used in after.items()},
    )


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
        counted, before = 0, None
        while True:
            # Counting is expensive: count only when the summaries reach the last second that was sent.
            ends = summarized_ends(cloud, name)
            over = time.monotonic() - since > _CATCH_UP_S
            if over or (ends and ends[1] - ends[0] + 1 >= seconds):
                counted = audit.samples_summarized(cloud, name, VESC_STREAM)
            if counted >= seconds * rate_hz or over:
                break
            if before != (counted, ends):
                since = since if before is None else time.monotonic()
            before = counted, ends
            threading.Event().wait(0.5)
        total += counted
    return total


def run(target: Target, say: Say, *, robots: list[int], seconds: int, rate: int) -> Section:
    """Drive a fleet of each number."""
    section, embedded = Section("fleet", "Many robots at once"), target.embedded
    if embedded is None:
        section.notes.append("Not run on AWS: what the quotas allow is in the section on cost.")
        return section
    runs = [measure(embedded, count, seconds, rate, say) for count in robots]
    columns = [run.figures() for run in runs]
    section.table(
        f"Robots with a certificate and a session each, a batch of {rate} samples a second for {seconds} s",
        ["", *(f"{run.robots} robot{'s' * (run.robots > 1)}" for run in runs)],
        [[name, *(column[name] for column in columns)] for name in columns[0]],
    )
    section.ratio("samples lost in all fleets", sum(run.samples_lost for run in runs), 0, unit="samples")
    bad = sum(not run.good for run in runs)
    section.ratio("fleets with a batch lost, doubled or out of order", bad, 0, unit="fleets")
    section.notes.append("All share this machine's cores, the robots as well.")
    section.raw = {"runs": [asdict(run) for run in runs]}
    return section


SECTION = Declared(
    "many robots on the embedded cloud",
    run,
    (
        Option("ROBOTS", numbers, [1, 10, 100, 500], "one run for each number"),
        Option("SECONDS", int, 10, "how long they drive"),
        Option("RATE", int, 50, "samples a second of each"),
    ),
)
