"""What the bench's commands share: their options, and the figures as a file."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

from bench.report import machine


def parser(documentation: str | None) -> argparse.ArgumentParser:
    """Return a parser with the option --json."""
    made = argparse.ArgumentParser(description=(documentation or "").splitlines()[0])
    made.add_argument("--json", type=Path, metavar="FILE", help="write the figures as JSON too")
    return made


def made() -> dict[str, Any]:
    """Return the date, the machine and the versions behind figures."""
    return {"machine": machine.describe()}


def write(path: Path | None, figures: Any) -> None:
    """Write the figures, if there is a file for them."""
    if path:
        path.write_text(json.dumps(figures, indent=2) + "\n")
