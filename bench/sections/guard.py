"""Holds the figures of a new report against those of the one in the repository.

A figure may be worse by its tolerance (`bench.report.Ratio.tolerance`), whatever its target. A figure
that was 0 (samples lost) must stay 0. A ratio to a constant is really a time: on another kind of machine
it is held to its target alone. A figure that a section no longer has counts as worse.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from bench.report import Ratio, Report, Section
from bench.sections import Declared, Option
from testkit import ROOT
from testkit.target import Say, Target
from testkit.waiting import InstrumentError

Figures = dict[str, Any]
# Machines with the same values are of one kind.
_KIND = ("cpu", "cores")


def ratios(report: Figures) -> dict[str, Ratio]:
    """Return the ratios of a report by name; an older report may lack some of their settings."""
    return {ratio["name"]: Ratio(**ratio) for section in report["sections"] for ratio in section["ratios"]}


def regressions(new: Figures, old: Figures) -> list[str]:
    """Return a line for each figure that became worse, of sections that are in both reports."""
    now, before = ratios(new), ratios(old)
    of_a_kind = all(new["machine"].get(key) == old["machine"].get(key) for key in _KIND)
    measured = {section["key"] for section in new["sections"]}
    lines = [
        f"{name}: {ratio.value:g} {ratio.unit}, was {before[name].value:g}"
        for name, ratio in now.items()
        if name in before and _worse(ratio, before[name].value, of_a_kind=of_a_kind)
    ]
    kept = (ratio for section in old["sections"] if section["key"] in measured for ratio in section["ratios"])
    return lines + [f"{ratio['name']}: no longer measured" for ratio in kept if ratio["name"] not in now]


def _worse(now: Ratio, was: float, *, of_a_kind: bool) -> bool:
    if now.by_machine and not of_a_kind:
        return now.reached is False
    return now.value < was / now.tolerance if now.at_least else now.value > was * now.tolerance


def run(_target: Target | None, _say: Say, *, new: Path, old: Path) -> Section:
    """Compare the reports. Raises `InstrumentError` if they cannot be compared."""
    try:
        now, before = (json.loads(path.read_text()) for path in (new, old))
    except (OSError, ValueError) as error:
        raise InstrumentError(f"{error}; `make bench` writes a report") from error
    compared = ratios(now).keys() & ratios(before).keys()
    if now["target"] != before["target"] or not compared:
        raise InstrumentError(f"{new} has no figure of {old} on its target, {before['target']}")
    worse = regressions(now, before)
    section = Section("guard", "Against the report that is kept")
    section.table(f"{len(compared)} figures compared", ["figure that became worse"], [[one] for one in worse])
    section.ratio("figures that became worse", len(worse), 0, unit="figures")
    lacking = {section["key"] for section in before["sections"]} - {
        section["key"] for section in now["sections"]
    }
    if lacking:
        section.notes.append(f"Not measured, so not compared: {', '.join(sorted(lacking))}.")
    return section


SECTION = Declared(
    "the figures of the last `make bench`, against those of docs/bench",
    run,
    (
        Option("NEW", Path, ROOT / "build" / "bench" / "report.json", "the new report"),
        Option("OLD", Path, ROOT / "docs" / "bench" / "report.json", "the one that is kept"),
    ),
    Report("guard", "The last report against the one that is kept", "make bench ONLY=guard"),
    cloud=False,
)
