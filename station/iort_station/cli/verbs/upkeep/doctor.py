"""`iort doctor`: what is wrong with the cloud, or will be, and what to do."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from botocore.exceptions import BotoCoreError, ClientError
from rich.text import Text

from iort_station.cli.console import out, print_json
from iort_station.cli.options import AsJson, State, state_folder
from iort_station.cli.progress import bar
from iort_station.cli.words import examples
from iort_station.errors import StationError

if TYPE_CHECKING:
    from iort_station.cloud import Cloud
    from iort_station.upkeep.deployment import Finding

commands = typer.Typer()
_STYLES = {"ok": "green", "warn": "yellow", "fail": "bold red"}


@commands.command("doctor", epilog=examples("doctor", "doctor --deep", "doctor --json"))
def doctor_(
    context: typer.Context,
    state: State = None,
    deep: Annotated[
        bool,
        typer.Option("--deep", help="Also read and decode all that is stored, and name what is damaged."),
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Say what is wrong with the cloud, or will be: a line for each thing, and what to do about it.

    Of the cloud of `make up`: processes, servers, disk, memory, certificates, clock, backup. Of every cloud:
    how far summaries are behind, the load, alarms. Exit status 0 if nothing fails, 1 otherwise.
    """
    found = []
    for finding in _findings(context, state, deep=deep):
        found.append(finding)
        if not as_json:
            _print(finding)
    if as_json:
        print_json([finding._asdict() for finding in found])
    raise typer.Exit(1 if any(finding.level == "fail" for finding in found) else 0)


def _findings(context: typer.Context, state: Path | None, *, deep: bool) -> Iterator[Finding]:
    findings, cloud = _looked_at(context, state)
    yield from findings
    if deep:
        yield from _deep(cloud)


def _looked_at(context: typer.Context, state: Path | None) -> tuple[Iterator[Finding], Callable[[], Cloud]]:
    """What is found at a first look, and how to get the cloud that is meant."""
    from iort_station import kept  # noqa: PLC0415 - as below
    from iort_station.cloud import Cloud  # noqa: PLC0415 - as below
    from iort_station.upkeep import doctor  # noqa: PLC0415 - it loads TLS and more

    folder = state_folder(context, state)

    def kept_cloud() -> Cloud:
        return Cloud.load(folder / kept.CLOUD)

    if state is not None or context.obj.means_kept(folder):
        return doctor.of_kept(folder), kept_cloud
    try:
        cloud = context.obj.cloud()
    except StationError:
        if not folder.is_dir():
            raise
        # It was stopped, and nothing else is meant.
        return doctor.of_kept(folder), kept_cloud
    return doctor.of_cloud(cloud), lambda: cloud


def _deep(find: Callable[[], Cloud]) -> Iterator[Finding]:
    from rich.progress import DownloadColumn, TextColumn  # noqa: PLC0415 - it takes long to load

    from iort_station.fleet import files  # noqa: PLC0415 - as below
    from iort_station.upkeep import deployment  # noqa: PLC0415 - it loads numpy and pyarrow
    from iort_station.upkeep.deployment import FAIL, Finding  # noqa: PLC0415 - as above

    try:
        cloud = find()
        topics = deployment.topics(cloud)
        with bar("reading recordings", None, TextColumn("{task.completed:,} batches")) as progress:
            found = list(deployment.of_recordings(cloud, topics, progress))
        yield from found
        listed = list(files.listed(cloud, None))
        with bar("reading files", sum(one.size for one in listed), DownloadColumn()) as progress:
            found = list(deployment.of_files(cloud, listed, progress))
        yield from found
    except (StationError, ClientError, BotoCoreError) as error:
        yield Finding("stored", FAIL, f"cannot be read: {error}", "see the lines above")


def _print(finding: Finding) -> None:
    out.print(
        Text.assemble((f"{finding.level:<5}", _STYLES[finding.level]), f" {finding.what}: {finding.text}"),
        soft_wrap=True,
    )
    if finding.todo:
        out.print(f"      -> {finding.todo}", soft_wrap=True)
