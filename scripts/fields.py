"""Writes the field table of contract/ into README.md: `python scripts/fields.py`."""

from __future__ import annotations

import re
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))

from iort_contract.vesc import VESC_FIELDS

_BLOCK = re.compile(r"(<!-- fields:.*?-->\n).*?(\n<!-- /fields -->)", re.DOTALL)


def table() -> str:
    """The table as Markdown."""
    rows = ["| field | unit | meaning | ROS |", "|---|---|---|---|"]
    for field in VESC_FIELDS.values():
        versions = ", ".join(map(str, field.ros))
        unit = f"{field.unit} (ROS 2: {field.ros2_unit})" if field.ros2_unit else field.unit
        rows.append(f"| `{field.name}` | {unit} | {field.meaning} | {versions} |")
    return "\n".join(rows)


def filled(readme: str) -> str:
    """The README with the current table."""
    return _BLOCK.sub(lambda match: match[1] + table() + match[2], readme)


if __name__ == "__main__":
    path = ROOT / "README.md"
    path.write_text(filled(path.read_text()))
