"""`iort files`: bags, images and whatever else robots have uploaded."""

from __future__ import annotations

import fnmatch
import json
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer
from rich.progress import BarColumn, DownloadColumn, Progress, TextColumn, TransferSpeedColumn

from iort_station.cli.console import Console
from iort_station.cli.options import bounds
from iort_station.cloud import Cloud
from iort_station.data.inventory import check_registered
from iort_station.errors import StationError
from iort_station.fleet import files
from iort_station.fleet.files import CountProgress, StoredFile
from iort_station.times import iso_s

commands = typer.Typer(
    name="files", no_args_is_help=True, help="Bags, images and other files that robots have uploaded."
)
_out = Console(soft_wrap=True)
_errors = Console(stderr=True, soft_wrap=True)

_Start = Annotated[str | None, typer.Option("--from", help="Written from here on: ISO 8601, now or -10m.")]
_End = Annotated[str | None, typer.Option("--to", help="Written up to here.")]
_Last = Annotated[str | None, typer.Option(help="Written in the last so much: 5m, 2h, 7d.")]
_Json = Annotated[bool, typer.Option("--json", help="As JSON.")]
_Name = Annotated[str, typer.Option(help="Only names like this: '*.bag'.")]


@commands.command("list")
def list_(
    context: typer.Context,
    robot: str,
    name: _Name = "*",
    start: _Start = None,
    end: _End = None,
    last: _Last = None,
    as_json: _Json = False,
) -> None:
    """List a robot's files in the order of their time; one line of JSON a file with --json.

    What a robot that is no longer registered has uploaded stays, and is listed.
    """
    none = True
    for one in _chosen(context.obj.cloud(), robot, name, start, end, last):
        none = False
        if as_json:
            _out.print(json.dumps(asdict(one)))
        else:
            _out.print(f"{iso_s(one.second * 1_000_000)}  {one.size:>15,}  {one.name}")
    if none:
        _errors.print(f"no file of {robot} is like this")


@commands.command("get")
def get(
    context: typer.Context,
    robot: str,
    which: Annotated[
        list[str] | None, typer.Argument(help="Names or keys; of a name, the newest. Without: all.")
    ] = None,
    name: _Name = "*",
    start: _Start = None,
    end: _End = None,
    last: _Last = None,
    out: Annotated[Path, typer.Option(help="The folder to put them into.")] = Path(),
    as_json: _Json = False,
) -> None:
    """Download files, and check the SHA-256 that the robot gave. Several go into a folder for each time.

    What broke off goes on where it was.
    """
    cloud = context.obj.cloud()
    found = list(_chosen(cloud, robot, name, start, end, last))
    if which:
        found = [_newest(found, robot, one) for one in which]
    if not found:
        raise StationError(f"no file of {robot} is like this")
    apart = len({one.name for one in found}) < len(found)
    for one in found:
        folder = out / time.strftime("%Y%m%d-%H%M%S", time.gmtime(one.second)) if apart else out
        with _bar(one.name, one.size) as told:
            path = files.download(cloud, one, folder, told)
        if as_json:
            _out.print(json.dumps({**asdict(one), "path": str(path)}))
        else:
            _out.print(str(path))


@commands.command("empty")
def empty(
    context: typer.Context,
    yes: Annotated[bool, typer.Option("--yes", help="Do not ask.")] = False,
) -> None:
    """Delete every file of every robot, and the results of queries: before the stacks go."""
    cloud = context.obj.cloud()
    if not yes:
        typer.confirm(f"Delete every file of the deployment {cloud.namespace}, for good?", abort=True)
    gone = 0

    def told(count: int) -> None:
        nonlocal gone
        gone += count

    files.empty(cloud, told)
    _out.print(f"{gone} deleted")


def _chosen(
    cloud: Cloud, robot: str, name: str, start: str | None, end: str | None, last: str | None
) -> Iterator[StoredFile]:
    start_us, end_us = bounds(start, end, last, time.time_ns() // 1000)
    none = True
    for one in files.listed(cloud, robot, start_us=start_us, end_us=end_us):
        none = False
        if fnmatch.fnmatch(one.name, name):
            yield one
    if none and next(files.listed(cloud, robot), None) is None:
        check_registered(cloud, robot)


def _newest(found: list[StoredFile], robot: str, which: str) -> StoredFile:
    for one in reversed(found):
        if which in (one.name, one.key):
            return one
    raise StationError(
        f"{robot} has no file {which} in this range; `iort files list {robot}` shows what it has"
    )


@contextmanager
def _bar(name: str, size: int) -> Iterator[CountProgress]:
    """A bar of the bytes, on standard error, where somebody looks."""
    console = Console(stderr=True)
    columns = (
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        DownloadColumn(),
        TransferSpeedColumn(),
    )
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as bar:
        task = bar.add_task(name, total=size)
        yield lambda more: bar.advance(task, more)
