"""What a section of the bench found: tables, plots, ratios and the values behind them."""

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
    """A picture: ``svg`` is the whole file."""

    name: str
    title: str
    svg: str


@dataclass(frozen=True)
class Ratio:
    """A figure, and the most it may be; ``unit`` says ratio of what.

    Where ``at_least``, larger is better and ``target`` is the least. A target of None is not held.
    ``tolerance`` is how many times worse than in the report that is kept the guard lets it be: above what
    the same tree has shown on a machine with other work (docs/bench.md). ``by_machine`` says that the other
    half of the ratio is a constant, so that a slower machine has a larger one.
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
        """Whether the target is; None without one."""
        if self.target is None:
            return None
        return self.value >= self.target if self.at_least else self.value <= self.target


@dataclass
class Section:
    """One section of the report; ``raw`` are the values behind it, for whoever wants to look again."""

    key: str
    title: str
    tables: list[Table] = field(default_factory=list)
    plots: list[Plot] = field(default_factory=list)
    ratios: list[Ratio] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    raw: dict[str, Any] = field(default_factory=dict)
    seconds: float = 0.0

    def as_json(self) -> dict[str, Any]:
        """Without the pictures, which are files of their own."""
        found = asdict(self)
        found["plots"] = [{"name": plot.name, "title": plot.title} for plot in self.plots]
        return found
