"""Writes a report: Markdown and HTML with its pictures, and the values behind both as JSON."""

from __future__ import annotations

import html
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from bench.result import Ratio, Section, Table

NAME = "report"
_STYLE = """
body{font:15px/1.5 system-ui,sans-serif;max-width:62rem;margin:2rem auto;
  padding:0 1rem;color:#111;background:#fff}
table{border-collapse:collapse;margin:.6rem 0 1.4rem;font-size:13px;display:block;overflow-x:auto}
th,td{border-bottom:1px solid #ddd;padding:.3rem .6rem;text-align:right;white-space:nowrap}
th:first-child,td:first-child{text-align:left}th{background:#f5f5f5}svg{max-width:100%;height:auto}
.bad{color:#a40000;font-weight:600}.good{color:#00622c}figure{margin:0 0 1.2rem}p.note{color:#444}
"""


def headline(sections: Sequence[Section]) -> Table:
    """Every figure that holds on any machine, beside what it may be."""
    rows = [ratio_row(ratio) for section in sections for ratio in section.ratios]
    return Table(
        "Ratios, each measured side by side in this run", ["figure", "measured", "target", "reached"], rows
    )


def ratio_row(ratio: Ratio) -> list[str]:
    """Name, value, target and whether it is reached, as text."""
    unit = "" if ratio.unit == "x" else f" {ratio.unit}"
    sign = "at least" if ratio.at_least else "at most"
    target = "" if ratio.target is None else f"{sign} {ratio.target:g}{unit}"
    reached = "" if ratio.reached is None else "yes" if ratio.reached else "**no**"
    return [ratio.name, f"{ratio.value:g}{unit}", target, reached]


def markdown(sections: Sequence[Section], machine: dict[str, Any], target: str) -> str:
    """The report for a reader of the repository; pictures are files beside it."""
    parts = ["# The measured platform", "", _made(machine, target), "", _table(headline(sections))]
    for section in sections:
        parts += ["", f"## {section.title}", ""]
        for table in section.tables:
            parts += [f"**{table.title}**", "", _table(table), ""]
        for plot in section.plots:
            parts += [f"![{plot.title}]({NAME}-{plot.name}.svg)", ""]
        parts += [f"{note}\n" for note in section.notes]
        parts.append(f"*This section took {section.seconds:.0f} s.*")
    return "\n".join(parts).rstrip() + "\n"


def page(sections: Sequence[Section], machine: dict[str, Any], target: str) -> str:
    """The report as one HTML file that needs nothing else."""
    parts = [
        "<!doctype html><html lang=en><meta charset=utf-8><meta name=viewport content='width=device-width'>",
        f"<title>iort: the measured platform</title><style>{_STYLE}</style>",
        "<h1>The measured platform</h1>",
        f"<p>{html.escape(_made(machine, target))}</p>",
        _html_table(headline(sections)),
    ]
    for section in sections:
        parts.append(f"<h2 id={section.key}>{html.escape(section.title)}</h2>")
        parts += [f"<h3>{html.escape(table.title)}</h3>{_html_table(table)}" for table in section.tables]
        parts += [
            f"<figure role=img aria-label='{html.escape(plot.title)}'>{plot.svg}</figure>"
            for plot in section.plots
        ]
        parts += [f"<p class=note>{html.escape(note)}</p>" for note in section.notes]
    return "\n".join(parts) + "\n"


def write(folder: Path, sections: Sequence[Section], machine: dict[str, Any], target: str) -> None:
    """Write report.md, .html, .json and a picture a file; pictures of sections that are not there go."""
    folder.mkdir(parents=True, exist_ok=True)
    for old in folder.glob(f"{NAME}-*.svg"):
        old.unlink()
    for section in sections:
        for plot in section.plots:
            (folder / f"{NAME}-{plot.name}.svg").write_text(plot.svg)
    (folder / f"{NAME}.md").write_text(markdown(sections, machine, target))
    (folder / f"{NAME}.html").write_text(page(sections, machine, target))
    found = {"target": target, "machine": machine, "sections": [section.as_json() for section in sections]}
    (folder / f"{NAME}.json").write_text(json.dumps(found, indent=1, default=str) + "\n")


def _made(machine: dict[str, Any], target: str) -> str:
    packages = ", ".join(f"{name} {version}" for name, version in machine["packages"].items())
    return (
        f"Made by `make bench` on {machine['date'][:10]} on the target {target}: {machine['cores']} cores of "
        f"{machine['cpu']}, {machine['memory']}, {machine['kernel']}, Python {machine['python']}, load "
        f"{machine['load_1min']} at its start; commit {machine['commit']}; {packages}."
    )


def _table(table: Table) -> str:
    lines = [table.head, ["---", *["---:"] * (len(table.head) - 1)], *table.rows]
    return "\n".join("| " + " | ".join(cell.replace("|", "\\|") for cell in line) + " |" for line in lines)


def _html_table(table: Table) -> str:
    head = "".join(f"<th>{html.escape(name)}</th>" for name in table.head)
    rows = "".join("<tr>" + "".join(map(_cell, row)) + "</tr>" for row in table.rows)
    return f"<table><thead><tr>{head}</tr></thead><tbody>{rows}</tbody></table>"


def _cell(text: str) -> str:
    kind = {"yes": " class=good", "**no**": " class=bad"}.get(text, "")
    return f"<td{kind}>{html.escape(text.replace('**', ''))}</td>"
