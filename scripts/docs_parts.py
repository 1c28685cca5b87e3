"""Fills the generated parts of README.md, of docs/ and of the page's contract.ts: `make docs-parts`.

A part stands between two comments. The first holds a call of a function of this module, and cog
(https://cog.readthedocs.io) replaces what follows by what the function prints.
"""

from __future__ import annotations

import html
import json
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import typer
from cogapp import Cog
from typer.cli import get_docs_for_click

from bench.report.fleet_costs import fleets
from bench.report.result import Ratio
from iort_contract.catalog.derived import DERIVED
from iort_contract.catalog.streams import AGENT_FIELDS
from iort_contract.catalog.vesc import VESC
from iort_station.cli.main import app
from iort_station.cost import report
from iort_station.cost.prices import AS_OF, REGION
from iort_station.cost.usage import Usage
from scripts import cloud_tables
from scripts.page_contract import formula, page_contract

__all__ = [
    "agent",
    "alarms",
    "cost",
    "derived",
    "fields",
    "headline",
    "manual",
    "metrics",
    "page_contract",
    "rules",
    "settings",
]

ROOT = Path(__file__).resolve().parent.parent
FILES = tuple(
    ROOT / name
    for name in (
        "README.md",
        "docs/how-to/alarms.md",
        "docs/reference/deployment.md",
        "docs/reference/metrics.md",
        "docs/explanation/cost.md",
        "docs/reference/iort.md",
        "docs/reference/messages.md",
        "docs/explanation/processing.md",
    )
)
PAGE = ROOT / "station" / "web" / "src" / "base" / "contract.ts"
REPORT = ROOT / "docs" / "bench" / "report.json"


def main(*files: Path, check: bool = False) -> int:
    """Fill every part; with ``check`` change nothing, and return a status that is not 0 if one is old."""
    mode = ["--check", "--diff", "--check-fail-msg=run `make docs-parts`"] if check else ["-r"]
    command = ["cog", *mode, "-P", "-p", "from scripts.docs_parts import *", "--verbosity=1"]
    return int(Cog().main([*command, *map(str, files or (*FILES, PAGE))]))


def fields() -> None:
    """The VESC's fields, from the catalogue."""
    rows = []
    for field in VESC.fields:
        unit = f"{field.unit} (ROS 2: {field.ros2_unit})" if field.ros2_unit else field.unit
        versions = ", ".join(map(str, field.ros))
        rows.append((f"`{field.name}`", unit, field.meaning, field.group, versions))
    _table(("field", "unit", "meaning", "group", "ROS"), rows, right=False)


def derived() -> None:
    """The derived fields, from the catalogue."""
    rows = [(f"`{d.name}`", d.unit, d.meaning, f"`{formula(d)}`") for d in DERIVED.values()]
    _table(("derived field", "unit", "meaning", "formula"), rows, right=False)


def agent() -> None:
    """The agent's own figures, from the catalogue."""
    rows = [(f"`{field.name}`", field.unit, field.meaning) for field in AGENT_FIELDS.values()]
    _table(("field", "unit", "meaning"), rows, right=False)


def settings() -> None:
    """The deployment's parameters."""
    _table(("key", "default", "meaning"), cloud_tables.settings_rows(), right=False)


def rules() -> None:
    """The topic rules, from the catalogue."""
    _table(("rule", "what it does", "messages go to", "from"), cloud_tables.rule_rows(), right=False)


def metrics() -> None:
    """The metrics of the functions, from the catalogue."""
    head = ("metric", "function", "unit", "statistic", "chart", "alarm")
    _table(head, cloud_tables.metric_rows(), right=False)


def alarms() -> None:
    """The alarms, from the catalogue."""
    head = ("alarm", "what happened", "goes off", "what to do")
    _table(head, cloud_tables.alarm_rows(), right=False)


def cost(name: str) -> None:
    """A table of the cost model: a robot's hour, what changes if, or fleets of several sizes."""
    usage = Usage()
    if name == "scale":
        rows = fleets(usage)
    else:
        print(f"List prices of {AS_OF}, {REGION}, in US dollars; one robot, {usage.rate_hz:g} Hz.\n")
        rows = {"hour": report.robot_hour, "whatif": report.what_if}[name](usage)
    _table(rows.head, rows.body)


def headline() -> None:
    """The kept bench report's ratios that have a target, and the machine of the measurement."""
    kept = json.loads(REPORT.read_text())
    machine = kept["machine"]
    on = f"{machine['cores']} cores of {machine['cpu']}, target {kept['target']}"
    print(f"Made on {machine['date'][:10]} on {on}:\n")
    ratios = [Ratio(**ratio) for section in kept["sections"] for ratio in section["ratios"]]
    rows = [ratio.as_row() for ratio in ratios if ratio.target is not None]
    _table(("ratio, side by side in one run", "measured", "target", "reached"), rows)


def manual() -> None:
    """The command `iort`, as typer describes it."""
    root: Any = typer.main.get_command(app)
    root.commands = {name: verb.load() for name, verb in root.commands.items()}
    _whole_sentences(root)
    text = get_docs_for_click(obj=root, ctx=typer.Context(root), name="iort")
    # The page has a title of its own. The text is escaped for HTML; Markdown shows an apostrophe as it is.
    print(html.unescape(text.partition("\n\n")[2]).strip())


def _whole_sentences(group: Any) -> None:
    """Give each command its first sentence as summary; typer cuts it after 45 characters."""
    for command in group.commands.values():
        command.short_help = " ".join((command.help or "").split()).split(". ")[0].rstrip(".")
        if hasattr(command, "commands"):
            _whole_sentences(command)


def _table(head: Iterable[str], body: Iterable[Iterable[str]], *, right: bool = True) -> None:
    """Print a Markdown table; ``right`` aligns every column but the first."""
    titles = list(head)
    for row in (titles, ["---", *(("---:" if right else "---") for _ in titles[1:])], *body):
        print(f"| {' | '.join(row)} |")


if __name__ == "__main__":
    sys.exit(main())
