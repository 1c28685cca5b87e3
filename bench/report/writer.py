"""Writes a report: a Markdown page, its pictures as SVG files, and the values behind them as JSON."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from bench.report.result import Section, Table

NAME = "report"


def headline(sections: Sequence[Section]) -> Table:
    """Return a table of all ratios with their targets."""
    rows = [ratio.as_row() for section in sections for ratio in section.ratios]
    return Table(
        "Ratios, each measured side by side in this run", ["figure", "measured", "target", "reached"], rows
    )


def markdown(sections: Sequence[Section], machine: dict[str, Any], target: str) -> str:
    """The report as Markdown; it shows the pictures that `write` puts beside it."""
    packages = ", ".join(f"{name} {version}" for name, version in machine["packages"].items())
    made = (
        f"Made by `make bench` on {machine['date'][:10]} on the target {target}: {machine['cores']} cores of "
        f"{machine['cpu']}, {machine['memory']}, {machine['kernel']}, Python {machine['python']}, load "
        f"{machine['load_1min']} at its start; commit {machine['commit']}; {packages}."
    )
    parts = ["# The measured platform", "", made, "", headline(sections).as_markdown()]
    for section in sections:
        parts += ["", f"## {section.title}", ""]
        for table in section.tables:
            parts += [f"**{table.title}**", "", table.as_markdown(), ""]
        for plot in section.plots:
            parts += [f"![{plot.title}]({NAME}-{plot.name}.svg)", ""]
        parts += [f"{note}\n" for note in section.notes]
        parts.append(f"*This section took {section.seconds:.0f} s.*")
    return "\n".join(parts).rstrip() + "\n"


def write(folder: Path, sections: Sequence[Section], machine: dict[str, Any], target: str) -> None:
    """Write report.md, report.json and a file for each picture; remove the pictures of an earlier report."""
    folder.mkdir(parents=True, exist_ok=True)
    for old in folder.glob(f"{NAME}-*.svg"):
        old.unlink()
    for section in sections:
        for plot in section.plots:
            (folder / f"{NAME}-{plot.name}.svg").write_text(plot.svg)
    (folder / f"{NAME}.md").write_text(markdown(sections, machine, target))
    found = {"target": target, "machine": machine, "sections": [section.as_json() for section in sections]}
    (folder / f"{NAME}.json").write_text(json.dumps(found, indent=1, default=str) + "\n")
