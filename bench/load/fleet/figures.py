"""The figures of one run of a fleet, and their table."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from local.figures import Spread
from testkit.command import Table

# Summaries that are later are late.
BEHIND_S = 10.0


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
    cpu_s: float
    cpu_percent: dict[str, float]
    rss_mb: dict[str, float]

    @property
    def cpu_ms_a_batch(self) -> float:
        """Processor time of emulator and functions for a batch, until every summary was there."""
        return round(self.cpu_s / max(1, self.batches_sent) * 1000, 2)

    @property
    def keeps_up(self) -> bool:
        """Whether nothing is lost, and summaries are at most `BEHIND_S` behind."""
        return self.good and self.catch_up_s <= BEHIND_S and (self.summary_behind_s.p95 or 0) <= BEHIND_S

    @property
    def samples_lost(self) -> int:
        """Samples that were sent and are missing in the telemetry table or in the summary."""
        stored = self.samples_sent - self.batches_lost * self.rate_hz
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
        derived = ("samples_lost", "good", "keeps_up", "cpu_ms_a_batch")
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
    parts = list(runs[0].cpu_percent)
    rows += [[f"CPU, {part}", *(f"{run.cpu_percent[part]:.0f} %" for run in runs)] for part in parts]
    rows += [[f"memory, {part}", *(f"{run.rss_mb[part]:.0f} MB" for run in runs)] for part in parts]
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
