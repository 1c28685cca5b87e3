"""Writes the cost model's tables into README.md and docs/cost.md: `python scripts/costs.py`."""

from __future__ import annotations

import re
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))

from bench.fleet_costs import fleets
from iort_station.cost import report
from iort_station.cost.prices import AS_OF, REGION
from iort_station.cost.usage import Usage

_BLOCK = re.compile(r"(<!-- cost (\w+):.*?-->\n).*?(\n<!-- /cost -->)", re.DOTALL)
FILES = (ROOT / "README.md", ROOT / "docs" / "cost.md")


def tables() -> dict[str, str]:
    """Each table as Markdown, by the name in its comment."""
    usage = Usage()
    dated = f"List prices of {AS_OF}, {REGION}, in US dollars; one robot, {usage.rate_hz:g} Hz.\n\n"
    return {
        "hour": dated + markdown(report.robot_hour(usage)),
        "whatif": dated + markdown(report.what_if(usage)),
        "scale": markdown(fleets(usage)),
    }


def markdown(rows: report.Rows) -> str:
    """A Markdown table, numbers to the right."""
    lines = [rows.head, ("---", *("---:" for _ in rows.head[1:])), *rows.body]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def filled(text: str) -> str:
    """The text with the current tables."""
    known = tables()
    return _BLOCK.sub(lambda match: match[1] + known[match[2]] + match[3], text)


if __name__ == "__main__":
    for path in FILES:
        path.write_text(filled(path.read_text()))
