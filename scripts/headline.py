"""Writes the headline of the bench's report into README.md: `python scripts/headline.py`."""

from __future__ import annotations

import json
import re
import sys
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))

from bench.report.result import Ratio

REPORT = ROOT / "docs" / "bench" / "report.json"
_BLOCK = re.compile(r"(<!-- bench:.*?-->\n).*?(\n<!-- /bench -->)", re.DOTALL)


def table(report: dict[str, Any]) -> str:
    """The ratios that have a target, as Markdown, and the machine of the measurement."""
    machine = report["machine"]
    on = f"{machine['cores']} cores of {machine['cpu']}, target {report['target']}"
    made = f"Made on {machine['date'][:10]} on {on}:"
    ratios = [Ratio(**ratio) for section in report["sections"] for ratio in section["ratios"]]
    rows = ["| ratio, side by side in one run | measured | target | reached |", "|---|---:|---:|---:|"]
    rows += [f"| {' | '.join(ratio.as_row())} |" for ratio in ratios if ratio.target is not None]
    return "\n".join([made, "", *rows])


def filled(readme: str, report: dict[str, Any]) -> str:
    """The README with the current table."""
    return _BLOCK.sub(lambda match: match[1] + table(report) + match[2], readme)


if __name__ == "__main__":
    path = ROOT / "README.md"
    path.write_text(filled(path.read_text(), json.loads(REPORT.read_text())))
