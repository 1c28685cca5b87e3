"""The result of a section of the bench: tables, plots, ratios and the values behind them."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from statistics import median, quantiles
from typing import Any, NamedTuple

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
        """Add a picture; ``draw`` makes its SVG for a title (`bench.plots`)."""
        self.plots.append(Plot(name, title, draw(title)))

    def as_json(self) -> dict[str, Any]:
        """Return the section without its pictures, which have their own files."""
        found = asdict(self)
        found["plots"] = [{"name": plot.name, "title": plot.title} for plot in self.plots]
        return found


@dataclass(frozen=True)
class Spread:
    """Percentiles of ``n`` values, and the least and the greatest median of the repeats."""

    n: int
    p50: float
    p95: float
    p99: float
    low: float
    high: float

    def text(self, unit: str = "ms", digits: int = 2) -> str:
        """``1.20 ms (p95 2.10, p99 3.00; 1.10 to 1.30)``; only repeats have a range."""
        tail = f"p95 {self.p95:.{digits}f}, p99 {self.p99:.{digits}f}"
        repeats = "" if self.low == self.high else f"; {self.low:.{digits}f} to {self.high:.{digits}f}"
        return f"{self.p50:.{digits}f} {unit} ({tail}{repeats})"


def spread(repeats: Sequence[Sequence[float]]) -> Spread | None:
    """Return the spread of all values of all repeats; None without values."""
    medians = [median(values) for values in repeats if values]
    values = [value for repeat in repeats for value in repeat]
    if not values:
        return None
    cuts = quantiles(values, n=100, method="inclusive") if len(values) > 1 else values * 99
    return Spread(len(values), median(values), cuts[94], cuts[98], min(medians), max(medians))


def text(repeats: Sequence[Sequence[float]], unit: str = "ms", digits: int = 2) -> str:
    """Return the spread as text; a dash without values."""
    found = spread(repeats)
    return found.text(unit, digits) if found else NOT_MEASURED


def rounded(ways: Mapping[str, Sequence[Sequence[float]]], digits: int) -> dict[str, dict[str, float]]:
    """Return the spread of each way as numbers, for the values behind a report."""
    spreads = {name: spread(repeats) for name, repeats in ways.items()}
    return {
        name: {key: round(value, digits) for key, value in asdict(one).items()}
        for name, one in spreads.items()
        if one
    }


def ratio(ours: Sequence[Sequence[float]], floor: Sequence[Sequence[float]]) -> float | None:
    """Return the median, over the repeats, of ours / floor in the same repeat; None without a pair.

    A machine that is slow for a while slows both halves of a pair.
    """
    pairs = [
        median(one) / median(other)
        for one, other in zip(ours, floor, strict=False)
        if one and other and median(other) > 0
    ]
    return median(pairs) if pairs else None


class Report(NamedTuple):
    """A report: the name of its files, its title, and the command that makes it.

    One that is ``merged`` keeps the sections of the report that is there and that were not measured again.
    """

    name: str
    title: str
    command: str
    merged: bool = False


BENCH = Report("report", "The measured platform", "make bench")
ANALYSIS = Report("analysis", "The proof of the analysis", "make bench ONLY=analysis", merged=True)
KEPT = Report("kept", "The kept cloud: killed, and soaked", "make bench ONLY=kept,soak", merged=True)


def headline(sections: Sequence[Section]) -> Table:
    """Return a table of all ratios with their targets."""
    rows = [ratio.as_row() for section in sections for ratio in section.ratios]
    return Table(
        "Ratios, each measured side by side in this run", ["figure", "measured", "target", "reached"], rows
    )


def markdown(
    sections: Sequence[Section], machine: dict[str, Any], target: str, report: Report = BENCH
) -> str:
    """The report as Markdown; it shows the pictures that `write` puts beside it."""
    packages = ", ".join(f"{name} {version}" for name, version in machine["packages"].items())
    cores = f"{machine['cores']} cores of {machine['cpu']}"
    made = (
        f"Made by `{report.command}` on {machine['date'][:10]} on the target {target}: {cores}, "
        f"{machine['memory']}, {machine['kernel']}, Python {machine['python']}, load "
        f"{machine['load_1min']} at its start; commit {machine['commit']}; {packages}."
    )
    parts = [f"# {report.title}", "", made, "", headline(sections).as_markdown()]
    for section in sections:
        parts += ["", f"## {section.title}", ""]
        for table in section.tables:
            parts += [f"**{table.title}**", "", table.as_markdown(), ""]
        for plot in section.plots:
            parts += [f"![{plot.title}]({report.name}-{plot.name}.svg)", ""]
        parts += [f"{note}\n" for note in section.notes]
        if section.seconds:
            parts.append(f"*This section took {section.seconds:.0f} s.*")
    return "\n".join(parts).rstrip() + "\n"


def write(
    folder: Path,
    sections: Sequence[Section],
    machine: dict[str, Any],
    target: str,
    report: Report = BENCH,
) -> None:
    """Write the report as Markdown and JSON and a file for each picture; remove those of an earlier one."""
    folder.mkdir(parents=True, exist_ok=True)
    if report.merged and (folder / f"{report.name}.json").exists():
        sections, machine = _merged(*read(folder, report), sections, machine)
    for old in folder.glob(f"{report.name}-*.svg"):
        old.unlink()
    for section in sections:
        for plot in section.plots:
            (folder / f"{report.name}-{plot.name}.svg").write_text(plot.svg)
    (folder / f"{report.name}.md").write_text(markdown(sections, machine, target, report))
    found = {"target": target, "machine": machine, "sections": [section.as_json() for section in sections]}
    (folder / f"{report.name}.json").write_text(json.dumps(found, indent=1, default=str) + "\n")


def read(folder: Path, report: Report = BENCH) -> tuple[list[Section], dict[str, Any]]:
    """The sections of a report that `write` wrote, and its machine."""
    found = json.loads((folder / f"{report.name}.json").read_text())
    for section in found["sections"]:
        section["tables"] = [Table(**one) for one in section["tables"]]
        section["ratios"] = [Ratio(**one) for one in section["ratios"]]
        section["plots"] = [
            Plot(**one, svg=(folder / f"{report.name}-{one['name']}.svg").read_text())
            for one in section["plots"]
        ]
    return [Section(**section) for section in found["sections"]], found["machine"]


def _merged(
    old: Sequence[Section], then: dict[str, Any], new: Sequence[Section], now: dict[str, Any]
) -> tuple[Sequence[Section], dict[str, Any]]:
    """The sections of both, and the machine of the ones that stay; the others note theirs."""
    again = {section.key: section for section in new}
    if all(section.key in again for section in old):
        return new, now
    for section in new:
        section.notes.append(f"Measured on {now['date'][:10]}, commit {now['commit']}.")
    return [again.pop(section.key, section) for section in old] + list(again.values()), then
