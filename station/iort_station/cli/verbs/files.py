"""`iort files`: bags, images and other files that robots have uploaded."""

from __future__ import annotations

import fnmatch
import json
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Annotated, Any

import typer
from botocore.exceptions import ClientError
from rich.progress import DownloadColumn, TransferSpeedColumn

from iort_station.cli import console, options
from iort_station.cli.console import bar, listing
from iort_station.cli.options import AsJson, Force, Robot, When, Yes, argument, examples, option, ranged
from iort_station.cloud import Cloud
from iort_station.errors import StationError, unknown
from iort_station.fleet import files, registry
from iort_station.fleet.files import StoredFile
from iort_station.times import iso_s, stamped

commands = typer.Typer(
    name="files", no_args_is_help=True, help="Bags, images and other files that robots have uploaded."
)

_Name = Annotated[str, option("Only names that match, for example '*.bag'.")]


@commands.command("list", epilog=examples("files list car7 --name '*.bag' --last 7d"))
@ranged
def list_(
    context: typer.Context, robot: Robot, when: When, name: _Name = "*", as_json: AsJson = False
) -> None:
    """List a robot's files in the order of their time.

    The files of a robot that is no longer registered stay, and are listed.
    """
    listed = _chosen(context.obj.cloud(), robot, name, when.range())
    listing(listed, _as_json, _show, as_json=as_json, none="no matching files")


def _show(file: StoredFile) -> None:
    console.out.print(f"{iso_s(file.second * 1_000_000)}  {file.size:>15,}  {file.name}", soft_wrap=True)


@commands.command("get", epilog=examples("files get car7 --name '*.bag' --out bags"))
@ranged
def get(
    context: typer.Context,
    robot: Robot,
    when: When,
    which: Annotated[
        list[str] | None,
        argument("Names or keys; a name means its newest file. Default: all.", autocompletion=options.files),
    ] = None,
    name: _Name = "*",
    out: Annotated[Path, option("The folder to write the files into.", "--out", "-o")] = Path(),
    force: Force = False,
    as_json: AsJson = False,
) -> None:
    """Download files, and check the SHA-256 that the robot gave.

    Files of the same name get a folder for each time. An interrupted download continues. A file that is
    damaged or cannot be fetched is named, and the others are fetched; the exit status is then 1.
    """
    within = when.range()
    cloud = context.obj.cloud()
    found = list(_chosen(cloud, robot, name, within))
    if which:
        found = [_newest(found, robot, one) for one in which]
    if not found:
        raise StationError(f"{robot} has no matching files")
    fetch(cloud, found, out, force=force, as_json=as_json)


def fetch(cloud: Cloud, found: Sequence[StoredFile], out: Path, *, force: bool, as_json: bool) -> None:
    """Download files into a folder and print their paths; those of the same name get a folder for each time.

    Raises `StationError` at the end if some could not be fetched; each is named.
    """
    apart = len({one.name for one in found}) < len(found)
    failed = 0
    for one in found:
        folder = out / time.strftime("%Y%m%d-%H%M%S", time.gmtime(one.second)) if apart else out
        try:
            with bar(one.name, one.size, DownloadColumn(), TransferSpeedColumn()) as progress:
                path = files.download(cloud, one, folder, progress, force=force)
        except (StationError, ClientError) as error:
            failed += 1
            named = str(error) if one.key in str(error) else f"{one.key}: {error}"
            console.errors.print(named, style="red", soft_wrap=True)
            continue
        text = json.dumps({**_as_json(one), "path": str(path)}) if as_json else str(path)
        console.out.print(text, soft_wrap=True)
    if failed:
        raise StationError(f"{failed} of {len(found)} files could not be fetched; they are named above")


@commands.command("empty", epilog=examples("files empty --yes"))
def empty(context: typer.Context, yes: Yes = False, as_json: AsJson = False) -> None:
    """Delete every file of every robot, and the results of queries. Do so before you destroy the stacks."""
    cloud = context.obj.cloud()
    options.agreed(f"Delete every file of the deployment {cloud.namespace}, for good?", yes=yes)
    counts: list[int] = []
    files.empty(cloud, counts.append)
    console.tell({"deleted": sum(counts)}, f"{sum(counts)} deleted", as_json=as_json)


def _chosen(cloud: Cloud, robot: str, name: str, within: options.Range) -> Iterator[StoredFile]:
    one = None
    for one in files.listed(cloud, robot, start_us=within.start_us, end_us=within.end_us):
        if fnmatch.fnmatch(one.name, name):
            yield one
    if one is None and next(files.listed(cloud, robot), None) is None:
        registry.get(cloud, robot)


def _as_json(file: StoredFile) -> dict[str, Any]:
    written, stored = (
        stamped("written", file.second * 1_000_000),
        stamped("stored", round(file.stored_s * 1e6)),
    )
    return {"key": file.key, "robot": file.robot, "name": file.name, "size": file.size, **written, **stored}


def _newest(files: list[StoredFile], robot: str, which: str) -> StoredFile:
    for file in reversed(files):
        if which in (file.name, file.key):
            return file
    problem = f"{robot} has no file {which} in this range"
    raise unknown(problem, [which], (file.name for file in files), f"iort files list {robot}")
