"""The result of a section of the bench: tables, ratios and the values behind them; and the report of them."""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from statistics import median
from typing import Any, NamedTuple

from local.figures import Spread
from testkit.command import Row, Table

NOT_MEASURED = "-"


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

    @property
    def of_target(self) -> float | None:
        """The figure as a part of its target, below 1 if reached; None without a target other than 0."""
        if not self.target or not self.value:
            return None
        return self.target / self.value if self.at_least else self.value / self.target


@dataclass
class Section:
    """One section of the report; ``raw`` has the values behind it."""

    key: str
    title: str
    tables: list[Table] = field(default_factory=list)
    ratios: list[Ratio] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    raw: dict[str, Any] = field(default_factory=dict)
    seconds: float = 0.0

    def table(self, title: str, head: Row, rows: Iterable[Row]) -> None:
        self.tables.append(Table(title, list(head), [list(row) for row in rows]))

    def ratio(self, name: str, value: float | None, target: float | None, **settings: Any) -> None:
        """Add a figure, to four digits unless it is a count; none if it was not measured."""
        if value is not None:
            shown = value if isinstance(value, int) else float(f"{value:.4g}")
            self.ratios.append(Ratio(name, shown, target, **settings))


def spread(repeats: Iterable[Sequence[float]]) -> Spread:
    """Return the spread of all values of all repeats."""
    return Spread.of([value for repeat in repeats for value in repeat])


def text(repeats: Iterable[Sequence[float]], digits: int = 2) -> str:
    """Return the spread as text; a dash without values."""
    return spread(repeats).text(digits)


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


def draw(sections: Sequence[Section], path: Path) -> None:
    """Draw every figure beside its target, which is the line at 1, as a picture."""
    import matplotlib as mpl  # noqa: PLC0415 - the help and the guard draw nothing
    from matplotlib.figure import Figure  # noqa: PLC0415 - as above

    ratios = [(part, entry) for section in sections for entry in section.ratios if (part := entry.of_target)]
    with mpl.rc_context({"svg.hashsalt": "iort", "svg.fonttype": "none", "font.size": 9}):
        figure = Figure((9, 1 + 0.22 * len(ratios)), layout="constrained")
        axes = figure.add_subplot(xscale="log", xlabel="measured / target (left of the line: reached)")
        axes.axvline(1, color="#d55e00", linewidth=1)
        for row, (part, entry) in enumerate(reversed(ratios)):
            color = "#0072b2" if entry.reached else "#d55e00"
            axes.plot([1, part], [row, row], color=color, linewidth=1, alpha=0.4)
            axes.plot([part], [row], "o", color=color, markersize=5)
        labels = [f"{entry.name}: {entry.as_row()[1]}" for _, entry in reversed(ratios)]
        axes.set_yticks(range(len(labels)), labels)
        axes.margins(y=0.02)
        axes.grid(axis="x", alpha=0.3)
        figure.savefig(path, metadata={"Date": None})


def headline(sections: Sequence[Section]) -> Table:
    """Return a table of all ratios with their targets."""
    rows = [ratio.as_row() for section in sections for ratio in section.ratios]
    head = ["figure", "measured", "target", "reached"]
    return Table("Ratios, each measured side by side in this run", head, rows)


def markdown(
    sections: Sequence[Section], machine: dict[str, Any], target: str, report: Report = BENCH
) -> str:
    """The report as Markdown."""
    packages = ", ".join(f"{name} {version}" for name, version in machine["packages"].items())
    cores = f"{machine['cores']} cores of {machine['cpu']}"
    made = (
        f"Made by `{report.command}` on {machine['date'][:10]} on the target {target}: {cores}, "
        f"{machine['memory']}, {machine['kernel']}, Python {machine['python']}, load "
        f"{machine['load_1min']} at its start; commit {machine['commit']}; {packages}."
    )
    parts = [f"# {report.title}", "", made, "", headline(sections).as_markdown()]
    parts += ["", f"![Each figure beside its target]({report.name}.svg)"]
    for section in sections:
        parts += ["", f"## {section.title}", ""]
        for table in section.tables:
            parts += [f"**{table.title}**", "", table.as_markdown(), ""]
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
    """Write the report as Markdown and JSON, and its picture."""
    folder.mkdir(parents=True, exist_ok=True)
    if report.merged and (folder / f"{report.name}.json").exists():
        sections, machine = _merged(*read(folder, report), sections, machine)
    (folder / f"{report.name}.md").write_text(markdown(sections, machine, target, report))
    draw(sections, folder / f"{report.name}.svg")
    content = {"target": target, "machine": machine, "sections": list(map(asdict, sections))}
    (folder / f"{report.name}.json").write_text(json.dumps(content, indent=1, default=str) + "\n")


def read(folder: Path, report: Report = BENCH) -> tuple[list[Section], dict[str, Any]]:
    """The sections of a report that `write` wrote, and its machine."""
    content = json.loads((folder / f"{report.name}.json").read_text())
    for section in content["sections"]:
        section["tables"] = [Table(**table) for table in section["tables"]]
        section["ratios"] = [Ratio(**entry) for entry in section["ratios"]]
    return [Section(**section) for section in content["sections"]], content["machine"]


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
