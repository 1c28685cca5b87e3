"""`make bench-guard`: holds the figures of a new report against those of the one in the repository.

    python -m bench.guard [--new build/bench/report.json] [--old docs/bench/report.json]

A figure may be worse by its tolerance (`bench.report.result.Ratio.tolerance`), whatever its target. A figure
that was 0 (samples lost) must stay 0. A ratio to a constant is really a time: on another kind of machine
it is held to its target alone. A figure that a section no longer has counts as worse. The exit status is 1
if a figure is worse, and 2 if the reports cannot be compared.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NoReturn

from bench.report.result import Ratio
from testkit import ROOT

Report = dict[str, Any]
# Machines with the same values are of one kind.
_KIND = ("cpu", "cores")


def ratios(report: Report) -> dict[str, Ratio]:
    """Return the ratios of a report by name; an older report may lack some of their settings."""
    return {ratio["name"]: Ratio(**ratio) for section in report["sections"] for ratio in section["ratios"]}


def regressions(new: Report, old: Report) -> list[str]:
    """Return a line for each figure that became worse. A section must be in both reports."""
    found = []
    now, before = ratios(new), ratios(old)
    kind = all(new["machine"].get(key) == old["machine"].get(key) for key in _KIND)
    for name, ratio in now.items():
        if name in before and _worse(ratio, before[name].value, of_a_kind=kind):
            found.append(f"{name}: {ratio.value:g} {ratio.unit}, was {before[name].value:g}")
    measured = {section["key"] for section in new["sections"]}
    for section in old["sections"]:
        if section["key"] in measured:
            gone = {ratio["name"] for ratio in section["ratios"]} - now.keys()
            found += [f"{name}: no longer measured" for name in sorted(gone)]
    return found


def not_compared(new: Report, old: Report) -> list[str]:
    """Return the sections that the new report lacks."""
    measured = {section["key"] for section in new["sections"]}
    return [section["key"] for section in old["sections"] if section["key"] not in measured]


def _worse(now: Ratio, was: float, *, of_a_kind: bool) -> bool:
    if now.by_machine and not of_a_kind:
        return now.reached is False
    return now.value < was / now.tolerance if now.at_least else now.value > was * now.tolerance


def main(arguments: Sequence[str] | None = None) -> None:
    """Compare the reports and print each figure that became worse."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--new", type=Path, default=ROOT / "build" / "bench" / "report.json")
    parser.add_argument("--old", type=Path, default=ROOT / "docs" / "bench" / "report.json")
    options = parser.parse_args(arguments)
    try:
        new, old = (json.loads(path.read_text()) for path in (options.new, options.old))
    except (OSError, ValueError) as error:
        _cannot(f"{error}; `make bench` writes a report")
    if new["target"] != old["target"]:
        _cannot(f"a report of {new['target']} says nothing about one of {old['target']}")
    compared = ratios(new).keys() & ratios(old).keys()
    if not compared:
        _cannot(f"{options.new} has no figure of {options.old}")
    worse = regressions(new, old)
    print(f"{len(compared)} figures compared, {len(worse)} worse")
    for line in worse:
        print(f"  {line}")
    if left := not_compared(new, old):
        print(f"not measured, so not compared: {', '.join(left)}")
    sys.exit(1 if worse else 0)


def _cannot(why: str) -> NoReturn:
    print(f"bench-guard: {why}", file=sys.stderr)
    sys.exit(2)


if __name__ == "__main__":
    main()
