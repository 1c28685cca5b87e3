"""The figures of one run of a fleet, and their table."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from bench.load.fleet_load import SAMPLES as BATCH_SAMPLES
from bench.report.result import Table
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
    }
    rows = [[name, *(str(figure(run)) for run in runs)] for name, figure in figures.items()]
    parts = list(runs[0].cpu_percent)
    rows += [[f"CPU, {part}", *(f"{run.cpu_percent[part]:.0f} %" for run in runs)] for part in parts]
    rows += [[f"memory, {part}", *(f"{run.rss_mb[part]:.0f} MB" for run in runs)] for part in parts]
    head = ["", *(f"{run.robots} robot{'s' * (run.robots > 1)}" for run in runs)]
    title = f"Robots with a certificate and a session each, a batch of {BATCH_SAMPLES} samples a second"
    return Table(title, head, rows)
