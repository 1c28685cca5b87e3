"""`make bench-guard`: holds the ratios of a new report against those of the one in the repository.

    python -m bench.guard [--new build/bench/report.json] [--old docs/bench/report.json]

Ratios only, never times: a slower machine is slower for the floor as well. A ratio may be worse by half of
what it was before it counts as a regression; what was nothing (samples lost) must stay nothing.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import Any

from bench.machine import ROOT

TOLERANCE = 0.5


def ratios(report: dict[str, Any]) -> dict[str, dict[str, Any]]:
    """The ratios of a report by name."""
    return {ratio["name"]: ratio for section in report["sections"] for ratio in section["ratios"]}


def regressions(new: dict[str, Any], old: dict[str, Any]) -> list[str]:
    """What became worse, a line each; a ratio that only one report has is not compared."""
    found = []
    before = ratios(old)
    for name, now in ratios(new).items():
        if name not in before:
            continue
        was, value = float(before[name]["value"]), float(now["value"])
        worst = was / (1 + TOLERANCE) if now["at_least"] else was * (1 + TOLERANCE)
        worse = value < worst if now["at_least"] else value > worst
        # Within its target a ratio may move as it likes; without one it may not.
        if worse and not _reached(now):
            found.append(f"{name}: {value:g} {now['unit']}, was {was:g}")
    return found


def _reached(ratio: dict[str, Any]) -> bool:
    if ratio["target"] is None:
        return False
    value, target = float(ratio["value"]), float(ratio["target"])
    return value >= target if ratio["at_least"] else value <= target


def main() -> None:
    """Compare; exit status 1 where something became worse."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--new", type=Path, default=ROOT / "build" / "bench" / "report.json")
    parser.add_argument("--old", type=Path, default=ROOT / "docs" / "bench" / "report.json")
    options = parser.parse_args()
    try:
        new, old = (json.loads(path.read_text()) for path in (options.new, options.old))
    except (OSError, ValueError) as error:
        sys.exit(f"bench-guard: {error}; `make bench` writes a report")
    compared = ratios(new).keys() & ratios(old).keys()
    worse = regressions(new, old)
    print(f"{len(compared)} ratios compared, {len(worse)} worse")
    for line in worse:
        print(f"  {line}")
    sys.exit(1 if worse or not compared else 0)


if __name__ == "__main__":
    main()
