"""Writes a report: a Markdown page, its pictures as SVG files, and the values behind them as JSON."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from bench.report.result import Plot, Ratio, Section
from testkit.command import Table


class Report(NamedTuple):
    """A report: the name of its files, its title, and the command that makes it."""

    name: str
    title: str
    command: str


BENCH = Report("report", "The measured platform", "make bench")
ANALYSIS = Report("analysis", "The proof of the analysis", "make bench-analysis")


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
