"""Writes the report of `make bench-kept`: kept.md, kept.svg and kept.json."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from bench.keeping.kills import Kills
from bench.keeping.week import Soak
from bench.report import plots

_TITLE = "Memory of five cars' cloud"
_HEAD = """\
# The kept cloud: killed, and soaked

<!-- written by `make bench-kept OUT=docs/bench` -->

`make bench-kept` kills the cloud of `make up` at random moments of a drive, and lets it live through
hours of a clock that is set forward: [what that is, and what it says](../explanation/kept-cloud.md)."""


def write(folder: Path, killed: Kills | None, soaked: Soak | None, machine: dict[str, Any]) -> None:
    """Write the files. A part that was not measured now stays as it is in the report that is there."""
    folder.mkdir(parents=True, exist_ok=True)
    file = folder / "kept.json"
    figures = json.loads(file.read_text()) if file.exists() else {}
    for name, measured in (("kills", killed), ("soak", soaked)):
        if measured:
            figures[name] = {"machine": machine, "figures": measured.as_json()}
    parts = [_HEAD]
    if "kills" in figures:
        parts += ["## Killed", _machine(figures["kills"]["machine"])]
        parts += _kills(Kills.of_json(figures["kills"]["figures"]))
    if "soak" in figures:
        soak = Soak.of_json(figures["soak"]["figures"])
        parts += [f"## {soak.hours} hours of the clock", _machine(figures["soak"]["machine"])]
        parts += _soak(soak)
        (folder / "kept.svg").write_text(_plot(soak))
    (folder / "kept.md").write_text("\n\n".join(parts) + "\n")
    file.write_text(json.dumps(figures, indent=2) + "\n")


def _kills(killed: Kills) -> list[str]:
    table = killed.table()
    parts = [f"{table.title}.", table.as_markdown()]
    if killed.restart_s and killed.restart_s.p50 is not None:
        parts.append(f"The emulator answered again after {killed.restart_s.p50:.1f} s (median).")
    if killed.open_s:
        parts.append(
            "`open s`: how long before each kill of an agent its last stored sample was taken. What came "
            "after that was in the batch of a second that was still open. `all`: it had sent none."
        )
    return parts


def _soak(soaked: Soak) -> list[str]:
    table = soaked.table()
    return [f"{table.title}.", f"![{_TITLE}](kept.svg)", table.as_markdown()]


def _plot(soaked: Soak) -> str:
    draw = plots.over(
        [one.hour for one in soaked.looks],
        {
            "emulator": [one.emulator_mb for one in soaked.looks],
            "functions": [one.functions_mb for one in soaked.looks],
        },
        x_label="hours of the clock",
        y_label="MB",
    )
    return draw(_TITLE)


def _machine(found: dict[str, Any]) -> str:
    made = f"{found['date'][:10]}, {found['commit']}, a load of {found['load_1min']} at the end"
    return f"{found['cores']} cores of {found['cpu']}, {found['memory']}, {made}."
