"""Writes the report of `make bench-kept`: kept.md, kept.svg and kept.json."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from bench.keeping.kills import Kills
from bench.keeping.week import Soak
from bench.report import plots

_HEAD = """\
# The kept cloud: killed, and soaked

<!-- written by `make bench-kept OUT=docs/bench` -->

`make bench-kept` kills the cloud of `make up` at random moments of a drive, and lets it live through
hours of a clock that is set forward: [what that is, and what it says](../explanation/kept-cloud.md).
"""


def write(folder: Path, killed: Kills | None, soaked: Soak | None, figures: dict[str, Any]) -> None:
    """Write the files."""
    folder.mkdir(parents=True, exist_ok=True)
    parts = [_HEAD, _machine(figures["machine"])]
    if killed:
        table = killed.table()
        parts += [f"## Killed\n\n{table.title}.", table.as_markdown()]
        if killed.restart_s and killed.restart_s.p50 is not None:
            parts.append(f"The emulator answered again after {killed.restart_s.p50:.1f} s (median).")
        if killed.open_s:
            parts.append(
                "`open s`: how long before each kill of an agent its last stored sample was taken. What came "
                "after that was in the batch of a second that was still open. `all`: it had sent none."
            )
    if soaked:
        table = soaked.table()
        title = "Memory of five cars' cloud"
        draw = plots.over(
            [one.hour for one in soaked.looks],
            {
                "emulator": [one.emulator_mb for one in soaked.looks],
                "functions": [one.functions_mb for one in soaked.looks],
            },
            x_label="hours of the clock",
            y_label="MB",
        )
        (folder / "kept.svg").write_text(draw(title))
        parts += [
            f"## {soaked.hours} hours of the clock\n\n{table.title}.",
            f"![{title}](kept.svg)",
            table.as_markdown(),
        ]
    (folder / "kept.md").write_text("\n\n".join(parts) + "\n")
    (folder / "kept.json").write_text(json.dumps(figures, indent=2) + "\n")


def _machine(found: dict[str, Any]) -> str:
    made = f"{found['date'][:10]}, {found['commit']}, a load of {found['load_1min']} at the end"
    return f"{found['cores']} cores of {found['cpu']}, {found['memory']}, {made}."
