"""`iort backup`, `restore`, `doctor` and `archive`: what keeps a cloud well, and what it keeps."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from botocore.exceptions import BotoCoreError, ClientError
from rich.progress import MofNCompleteColumn
from rich.text import Text

from iort_contract.topics import parse_topic
from iort_station.cli import options
from iort_station.cli.console import bar, listing, out, print_json, tell
from iort_station.cli.options import AsJson, DryRun, Force, State, argument, examples, option, say
from iort_station.data.recorded import archive_of
from iort_station.errors import StationError
from iort_station.operations import archive
from iort_station.times import iso_s

commands = typer.Typer()


@commands.command("backup", epilog=examples("backup cloud.tar"))
def backup_(
    context: typer.Context,
    file: Annotated[Path, argument("The archive to write.")],
    state: State = None,
    force: Force = False,
    as_json: AsJson = False,
) -> None:
    """Write the cloud of `make up` into one file: telemetry, files, robots, certificates. It goes on.

    Everything is of one moment. The file appears when it is whole. It has the cloud's private keys: only its
    owner can read it.
    """
    from iort_station.upkeep import backup  # noqa: PLC0415 - SQLite takes longer to load than TAB may take

    folder = options.running_state(context, state)
    say(f"of the cloud that is kept in {folder}")
    with bar("backup", backup.size_of(folder) if folder.exists() else None) as progress:
        made = backup.back_up(folder, file, force=force, progress=progress)
    facts = {"file": str(file), "bytes": made.size, "files": len(made.files), "state": str(folder)}
    tell(facts, f"{file}: {len(made.files):,} files, {made.size / 1e6:,.1f} MB, of {folder}", as_json=as_json)


# `iort doctor`: what is wrong with the cloud, or will be, and what to do.

if TYPE_CHECKING:
    from iort_contract.archive import ArchivedHour
    from iort_station.cloud import Cloud
    from iort_station.upkeep.deployment import Finding

_STYLES = {"ok": "green", "warn": "yellow", "fail": "bold red"}


@commands.command("doctor", epilog=examples("doctor", "doctor --deep", "doctor --json"))
def doctor_(
    context: typer.Context,
    state: State = None,
    deep: Annotated[
        bool, option("Also read and decode all that is stored, and name what is damaged.", "--deep")
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Say what is wrong with the cloud, or will be: a line for each thing, and what to do about it.

    Of the cloud of `make up`: processes, servers, disk, memory, certificates, clock, backup. Of every cloud:
    how far summaries are behind, the load, alarms. Exit status 0 if nothing fails, 1 otherwise.
    """
    first, cloud = _looked_at(context, state)
    findings = []
    for finding in chain(first, _deep(cloud) if deep else ()):
        findings.append(finding)
        if not as_json:
            _print(finding)
    if as_json:
        print_json([finding._asdict() for finding in findings])
    raise typer.Exit(1 if any(finding.level == "fail" for finding in findings) else 0)


def _looked_at(context: typer.Context, state: Path | None) -> tuple[Iterator[Finding], Callable[[], Cloud]]:
    """What is found at a first look, and how to get the cloud that is meant."""
    from iort_station import kept  # noqa: PLC0415 - as below
    from iort_station.cloud import Cloud  # noqa: PLC0415 - as below
    from iort_station.upkeep import doctor  # noqa: PLC0415 - it loads TLS and more

    folder = options.state_folder(context, state)

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


# `iort restore`: a kept cloud from its backup.


@commands.command("restore", epilog=examples("restore cloud.tar --dry-run"))
def restore_(
    context: typer.Context,
    file: Annotated[Path, argument("The archive of `iort backup`.")],
    state: State = None,
    force: Annotated[
        bool, option("Also where a state is already; that one is renamed, and kept.", "--force")
    ] = False,
    dry_run: DryRun = False,
    as_json: AsJson = False,
) -> None:
    """Make the state folder of a cloud from its backup; `make up` then starts it.

    Every file is compared with its hash first. The folder appears when it is whole, and never where a cloud
    runs. --dry-run only reads the archive, and says whether it is good.
    """
    from iort_station.upkeep import backup  # noqa: PLC0415 - as in `iort backup`

    folder, earlier = options.state_folder(context, state), None
    if not dry_run:
        say(f"to {folder}, for `make up`")
    with bar("restore", file.stat().st_size) as progress:
        if dry_run:
            manifest = backup.verify(file, progress)
        else:
            manifest, earlier = backup.restore(file, folder, force=force, progress=progress)
    made = iso_s(round(manifest.made_s * 1e6))
    text = f"{file}: good, {len(manifest.files):,} files, {manifest.size / 1e6:,.1f} MB, of {made}"
    if not dry_run:
        text += f"; restored to {folder}" + (f", where the earlier state is {earlier} now" if earlier else "")
    facts = {
        "file": str(file),
        "made": made,
        "bytes": manifest.size,
        "files": len(manifest.files),
        "state": None if dry_run else str(folder),
        "earlier": None if earlier is None else str(earlier),
    }
    tell(facts, text, as_json=as_json)


# `iort archive`: telemetry that is kept for good, as Parquet.

archive_commands = typer.Typer(
    name="archive", no_args_is_help=True, help="Telemetry that is kept for good, as Parquet in the bucket."
)
commands.add_typer(archive_commands)

_EMPTY = "nothing is archived yet: an hour is, from a quarter past the next one"

_Robot = Annotated[
    str | None, argument("Only this robot; needed for a removed one.", autocompletion=options.robots)
]
_Stream = Annotated[str | None, argument("Only this stream.", autocompletion=options.streams)]


@archive_commands.command("show", epilog=examples("archive show car7"))
def show(
    context: typer.Context, robot: _Robot = None, stream: _Stream = None, as_json: AsJson = False
) -> None:
    """List the streams in the archive: hours, samples, bytes."""
    cloud = context.obj.cloud()
    topics = archive.topics(cloud, robot, stream)
    rows = (_archived(topic, hours) for topic in topics if (hours := list(archive_of(cloud, topic).rows())))
    listing(rows, dict, _show_archived, as_json=as_json, none=_EMPTY)


def _archived(topic: str, hours: list[ArchivedHour]) -> dict[str, Any]:
    name = parse_topic(topic)
    counts = {
        count: sum(getattr(hour, count) for hour in hours) for count in ("batches", "samples", "refused")
    }
    return {
        "robot": name.robot,
        "stream": name.name,
        "first": hours[0].hour,
        "last": hours[-1].hour,
        "hours": len(hours),
        **counts,
        # The hours of a day are one object.
        "bytes": sum({hour.key: hour.size_bytes for hour in hours}.values()),
    }


def _show_archived(row: dict[str, Any]) -> None:
    out.print(
        f"{row['robot']} {row['stream']}: {row['hours']:,} hours from {row['first']} to {row['last']}, "
        f"{row['samples']:,} samples, {row['bytes']:,} bytes",
        soft_wrap=True,
    )


@archive_commands.command("run", epilog=examples("archive run", "archive run car7 vesc"))
def run(
    context: typer.Context, robot: _Robot = None, stream: _Stream = None, as_json: AsJson = False
) -> None:
    """Archive now what the schedule would in the next hours, and wait for it. The current hour stays."""
    cloud = context.obj.cloud()
    topics = archive.topics(cloud, robot, stream)
    with bar("looking for hours", len(topics), MofNCompleteColumn()) as progress:
        hours = 0
        for topic in topics:
            hours += archive.run(cloud, topic)
            progress(1)
    if hours:
        with bar("archiving", hours, MofNCompleteColumn()) as progress:
            done = 0

            def step(left: int) -> None:
                nonlocal done
                progress(max(0, hours - left) - done)
                done = max(0, hours - left)

            archive.wait(cloud, step)
    tell({"hours": hours}, f"{hours} hours done", as_json=as_json)


@archive_commands.command("verify", epilog=examples("archive verify", "archive verify car7 vesc"))
def verify(
    context: typer.Context, robot: _Robot = None, stream: _Stream = None, as_json: AsJson = False
) -> None:
    """Prove that the archive holds every batch: compare table, manifest and objects. All of it is read.

    Fails if anything is missing. `iort doctor --deep` looks at every stream, and at files.
    """
    cloud = context.obj.cloud()
    wrong = 0

    def rows() -> Iterator[dict[str, Any]]:
        nonlocal wrong
        for topic in archive.topics(cloud, robot, stream):
            row = _verified(cloud, topic)
            wrong += len(row["problems"])
            if row["hours"] or row["problems"]:
                yield row

    listing(rows(), dict, _show_verified, as_json=as_json, none=_EMPTY)
    if wrong:
        raise StationError(
            f"{wrong} hours are not as they should be: `iort archive run`, then look at `iort alarms`"
        )


def _verified(cloud: Cloud, topic: str) -> dict[str, Any]:
    name, found = parse_topic(topic), archive.verify(cloud, topic)
    problems = {hour: f"{count} batches are not archived" for hour, count in found.lacking.items()}
    return {
        "robot": name.robot,
        "stream": name.name,
        "hours": found.hours,
        "samples": found.samples,
        "problems": problems | found.damaged,
        "refused": found.refused.count,
        "named": found.refused.named,
    }


def _show_verified(row: dict[str, Any]) -> None:
    lines = [f"{row['robot']} {row['stream']}: {row['hours']:,} hours, {row['samples']:,} samples"]
    lines += [f"    {hour}: {problem}" for hour, problem in row["problems"].items()]
    lines += [f"    cannot be decoded: {line}" for line in row["named"]]
    for line in lines:
        out.print(line, soft_wrap=True)
