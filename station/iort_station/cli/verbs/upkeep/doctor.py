"""`iort doctor`: what is wrong with the cloud, or will be, and what to do."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import typer
from rich.text import Text

from iort_station.cli.console import out, print_json
from iort_station.cli.options import AsJson, State, state_folder
from iort_station.cli.words import examples
from iort_station.errors import StationError

if TYPE_CHECKING:
    from iort_station.upkeep.finding import Finding

commands = typer.Typer()
_STYLES = {"ok": "green", "warn": "yellow", "fail": "bold red"}


@commands.command("doctor", epilog=examples("doctor", "doctor --json"))
def doctor_(context: typer.Context, state: State = None, as_json: AsJson = False) -> None:
    """Say what is wrong with the cloud, or will be: a line for each thing, and what to do about it.

    Of the cloud of `make up`: processes, servers, disk, memory, certificates, clock, backup. Of every cloud:
    how far summaries are behind, the load, alarms. Exit status 0 if nothing fails, 1 otherwise.
    """
    found = []
    for finding in _findings(context, state):
        found.append(finding)
        if not as_json:
            _print(finding)
    if as_json:
        print_json([finding._asdict() for finding in found])
    raise typer.Exit(1 if any(finding.level == "fail" for finding in found) else 0)


def _findings(context: typer.Context, state: Path | None) -> Iterator[Finding]:
    from iort_station.upkeep import doctor  # noqa: PLC0415 - it loads TLS and more

    folder = state_folder(context, state)
    if state is not None or context.obj.means_kept(folder):
        return doctor.of_kept(folder)
    try:
        return doctor.of_cloud(context.obj.cloud())
    except StationError:
        if not folder.is_dir():
            raise
        # It was stopped, and nothing else is meant.
        return doctor.of_kept(folder)


def _print(finding: Finding) -> None:
    out.print(
        Text.assemble((f"{finding.level:<5}", _STYLES[finding.level]), f" {finding.what}: {finding.text}"),
        soft_wrap=True,
    )
    if finding.todo:
        out.print(f"      -> {finding.todo}", soft_wrap=True)
