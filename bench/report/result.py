"""The result of a section of the bench: tables, plots, ratios and the values behind them."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass, field
from typing import Any

from testkit.command import Row, Table

NOT_MEASURED = "-"


@dataclass(frozen=True)
class Plot:
    """A picture; ``svg`` is the text of the file."""

    name: str
    title: str
    svg: str


@dataclass(frozen=True)
class Ratio:
    """A figure with its unit (``x`` for a ratio) and its target, which is the most that it may be.

    With ``at_least`` larger is better and ``target`` is the least. None means no target. The guard accepts a
    figure that is ``tolerance`` times worse than in the kept report; this exceeds the variation of one tree
    on a machine with other work (docs/explanation/benchmark.md). ``by_machine`` marks a ratio to a constant,
    which a slower machine makes larger.
    """

    name: str
    value: float
    target: float | None
    unit: str = "x"
    at_least: bool = False
    tolerance: float = 1.5
    by_machine: bool = False

    @property
    def reached(self) -> bool | None:
        """True if the target is reached; None without a target."""
        if self.target is None:
            return None
        return self.value >= self.target if self.at_least else self.value <= self.target

    def as_row(self) -> list[str]:
        """Return name, value, target and whether it is reached, as text."""
        unit = "" if self.unit == "x" else f" {self.unit}"
        sign = "at least" if self.at_least else "at most"
        target = "" if self.target is None else f"{sign} {self.target:g}{unit}"
        reached = "" if self.reached is None else "yes" if self.reached else "**no**"
        return [self.name, f"{self.value:g}{unit}", target, reached]


@dataclass
class Section:
    """One section of the report; ``raw`` has the values behind it."""

    key: str
    title: str
    tables: list[Table] = field(default_factory=list)
    plots: list[Plot] = field(default_factory=list)
    ratios: list[Ratio] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    raw: dict[str, Any] = field(default_factory=dict)
    seconds: float = 0.0

    def table(self, title: str, head: Row, rows: Iterable[Row]) -> None:
        self.tables.append(Table(title, list(head), [list(row) for row in rows]))

    def ratio(self, name: str, value: float | None, target: float | None, **settings: Any) -> None:
        """Add a figure, unless it was not measured."""
        if value is not None:
            self.ratios.append(Ratio(name, value, target, **settings))

    def plot(self, name: str, title: str, draw: Callable[[str], str]) -> None:
        """Add a picture; ``draw`` makes its SVG for a title (`bench.report.plots`)."""
        self.plots.append(Plot(name, title, draw(title)))

    def as_json(self) -> dict[str, Any]:
        """Return the section without its pictures, which have their own files."""
        found = asdict(self)
        found["plots"] = [{"name": plot.name, "title": plot.title} for plot in self.plots]
        return found
