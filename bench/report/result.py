"""The result of a section of the bench: tables, plots, ratios and the values behind them."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from typing import Any

NOT_MEASURED = "-"


@dataclass(frozen=True)
class Table:
    """A table of the report: cells are text."""

    title: str
    head: list[str]
    rows: list[list[str]]


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
    on a machine with other work (docs/bench.md). ``by_machine`` marks a ratio to a constant, which a slower
    machine makes larger.
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

    def as_json(self) -> dict[str, Any]:
        """Return the section without its pictures, which have their own files."""
        found = asdict(self)
        found["plots"] = [{"name": plot.name, "title": plot.title} for plot in self.plots]
        return found
