"""The figures of a drive, beside those of the thesis that the project began from."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from statistics import quantiles
from typing import Any

from rich.table import Table

from iort_contract.catalog.streams import RTT_FIELDS
from iort_contract.messages.batch import Batch
from iort_contract.topics import BROKER, LAMBDA, PING_PATHS, RULE

# Round trips and the time from car to dashboard in ms, measured in 2018 between a car in Stockholm and AWS in
# Dublin, with a network ping of 50 ms (KTH thesis of 2018, table 6.4).
THESIS_MS = {BROKER: (50, 60), RULE: (100, 110), LAMBDA: (150, 200), "dashboard": (250, 300)}
THESIS = {way: f"{least} - {most}" for way, (least, most) in THESIS_MS.items()}
_NOT_MEASURED = "-"


@dataclass(frozen=True)
class Spread:
    """The median and the 95th percentile of ``n`` values in ms; None if there are no values."""

    p50: float | None
    p95: float | None
    n: int

    @classmethod
    def of(cls, values: Sequence[float]) -> Spread:
        """Summarise the values."""
        if len(values) < 2:
            only = round(values[0], 3) if values else None
            return cls(only, only, len(values))
        percents = quantiles(values, n=100, method="inclusive")
        return cls(round(percents[49], 3), round(percents[94], 3), len(values))

    def __str__(self) -> str:
        return self.text(1)

    def text(self, digits: int) -> str:
        """``1.2 ms (p95 2.1)``, or a dash without values."""
        if self.p50 is None or self.p95 is None:
            return _NOT_MEASURED
        return f"{self.p50:.{digits}f} ms (p95 {self.p95:.{digits}f})"


@dataclass(frozen=True)
class Figures:
    """The results of one drive."""

    samples_sent: int
    samples_stored: int
    samples_summarized: int
    live_published: int
    live_received: int
    rtt_ms: dict[str, Spread]
    car_to_dashboard_ms: Spread

    @property
    def samples_lost(self) -> int:
        """Samples that were sent and not stored, or stored and not summarised."""
        return self.samples_sent - min(self.samples_stored, self.samples_summarized)

    def as_json(self) -> dict[str, Any]:
        """The figures under the names of the report."""
        return asdict(self) | {"samples_lost": self.samples_lost}

    def as_table(self) -> Table:
        """The figures as a table for the terminal."""
        table = Table(title="The drive", title_justify="left", title_style="bold")
        table.add_column("figure")
        table.add_column("here", justify="right")
        table.add_column("thesis, 2018", justify="right")
        for name, count in (
            ("samples sent by the car", self.samples_sent),
            ("samples stored", self.samples_stored),
            ("samples summarised", self.samples_summarized),
            ("samples lost", self.samples_lost),
            ("live messages published", self.live_published),
            ("live messages received", self.live_received),
        ):
            style = "bold red" if name == "samples lost" and count else ""
            table.add_row(name, f"{count:,}", _NOT_MEASURED, style=style)
        table.add_section()
        for path in PING_PATHS:
            table.add_row(f"round trip, {path}", str(self.rtt_ms[path]), f"{THESIS[path]} ms")
        table.add_row("car to dashboard", str(self.car_to_dashboard_ms), f"{THESIS['dashboard']} ms")
        return table


def round_trips(batches: Iterable[Batch]) -> dict[str, Spread]:
    """The round trips of each path, from the stored batches of the stream ``rtt``."""
    values: dict[str, list[float]] = {path: [] for path in PING_PATHS}
    for batch in batches:
        for path, found in values.items():
            column = batch.columns.get(RTT_FIELDS[path], ())
            found.extend(float(value) for value in column if isinstance(value, (int, float)))
    return {path: Spread.of(found) for path, found in values.items()}
