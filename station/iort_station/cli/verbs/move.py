"""`iort move`: robots and what they have recorded, from one cloud into another."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.filesize import decimal
from rich.progress import DownloadColumn, TransferSpeedColumn

from iort_contract.tables import NO_ROBOT
from iort_station.cli import options
from iort_station.cli.console import bar, errors, out, print_json
from iort_station.cli.options import AsJson, CloudOptions, DryRun, argument, examples, option, resumable, say
from iort_station.cloud import EMBEDDED, Cloud
from iort_station.errors import StationError
from iort_station.fleet import registry

if TYPE_CHECKING:
    from iort_station.migration.plan import Plan

commands = typer.Typer()
AWS = "aws"


@commands.command("move", epilog=examples("move --to aws --to-profile lab", "move --to ~/cloud-2 car7"))
def move_(
    context: typer.Context,
    to: Annotated[
        str, option("An AWS account, or the folder of another embedded cloud.", metavar="aws|FOLDER")
    ],
    names: Annotated[
        list[str] | None, argument("Default: every robot.", metavar="ROBOT", autocompletion=options.robots)
    ] = None,
    to_profile: Annotated[str | None, option("The AWS profile of --to aws.")] = None,
    to_region: Annotated[str | None, option("The AWS region of --to aws.")] = None,
    bundles: Annotated[
        Path | None, option("Make a certificate for each robot there, in a bundle in this folder.")
    ] = None,
    with_files: Annotated[bool, option("Whether to copy the robots' files.", "--files/--no-files")] = True,
    same_robots: Annotated[
        bool, option("Robots that both sides have registered already are the same.", "--same-robots")
    ] = False,
    units: Annotated[
        int, option("Speed in write units of DynamoDB (1 KB) a second. A stream takes 1,000.", min=1)
    ] = 500,
    dry_run: DryRun = False,
    as_json: AsJson = False,
) -> None:
    """Copy robots into another deployment, with all that they have recorded and all that is known of them.

    The source stays as it is. A second run copies what is new, and an interrupted one goes on. Then both
    sides are compared, batch by batch and file by file; --dry-run only tells the plan and compares. A moved
    robot has no certificate there: it claims one, or gets a bundle by --bundles. Exit status 1 if something
    is missing or differs. See docs/how-to/move.md.
    """
    # numpy takes longer to load than TAB may take.
    from iort_station.data import inventory  # noqa: PLC0415 - see above
    from iort_station.migration import plan  # noqa: PLC0415 - as above

    source = context.obj.cloud()
    target = _target(source, to, to_profile, to_region)
    plan.check(source, target)
    with resumable("move"):
        for robot in names or ():
            # A robot that was removed has samples, and no row.
            inventory.check_recorded(source, registry.checked(robot))
        chosen = sorted(set(names or registry.presence(source)))
        plans = plan.plan(source, target, chosen, same_robots=same_robots)
        for one in plans:
            if not as_json:
                _show_plan(one, with_files=with_files)
        moving = _Moving(source, target, None if dry_run else units, with_files=with_files, quiet=as_json)
        for one in plans:
            moving.move(one, bundles)
        if not names:
            # Messages that name no robot.
            moving.quarantine(NO_ROBOT)
    if as_json:
        print_json({"streams": moving.streams, **moving.counts, "problems": moving.problems})
    else:
        _show_end(moving, plans)
    if moving.counts["registered"] and bundles is None:
        say("each new robot still needs a certificate there: `iort robots claim ROBOT`, docs/how-to/move.md")
    raise typer.Exit(1 if moving.problems else 0)


class _Moving:
    """Copies robot by robot, compares, and tells. Without ``units`` it only compares."""

    def __init__(
        self, source: Cloud, target: Cloud, units: int | None, *, with_files: bool, quiet: bool
    ) -> None:
        self._source, self._target, self._units = source, target, units
        self._with_files, self._quiet = with_files, quiet
        self.streams: list[dict[str, Any]] = []
        self.counts = dict.fromkeys(
            ("registered", "bundles", "findings", "quarantined", "files", "files_bytes"), 0
        )
        self.problems: list[str] = []

    def move(self, plan: Plan, bundles: Path | None) -> None:
        """Move a robot."""
        from iort_station.migration import robots  # noqa: PLC0415 - numpy, as above

        robot, between = plan.robot, (self._source, self._target)
        if self._units is not None:
            self.counts["registered"] += robots.copy(*between, robot)
            if bundles is not None:
                self.counts["bundles"] += robots.equip(self._target, robot, bundles)
            self.counts["findings"] += robots.copy_findings(*between, robot)
        self.quarantine(robot)
        for stream in plan.streams:
            self._stream(robot, stream)
        if self._with_files:
            self._files(plan)

    def quarantine(self, robot: str) -> None:
        """Move a robot's quarantined messages."""
        from iort_station.migration import robots  # noqa: PLC0415 - as above

        between = (self._source, self._target)
        if self._units is not None:
            self.counts["quarantined"] += robots.copy_quarantine(*between, robot)
        if lacking := robots.lacking(*between, robot):
            self._problem(f"{robot}: the target lacks {len(lacking):,} quarantined messages: move again")

    def _stream(self, robot: str, stream: str) -> None:
        from iort_station.data.recorded import topic_of  # noqa: PLC0415 - as above
        from iort_station.migration import recordings  # noqa: PLC0415 - as above

        source, target, topic = self._source, self._target, topic_of(self._source, robot, stream)
        batches = hours = 0
        with errors.status(f"{robot} {stream}") as status:
            read = 0

            def progress(more: int) -> None:
                nonlocal read
                read += more
                status.update(f"{robot} {stream}: {read:,} batches read")

            if self._units is not None:
                # Before the batches, which the target's archive adds to these hours.
                hours = recordings.copy_hours(source, target, topic)
                for copy in (recordings.copy_batches, recordings.merge_hours):
                    batches += copy(source, target, topic, units_per_s=self._units, progress=progress)
            found = recordings.compare(source, target, robot, stream, progress)
        if not found.batches:
            return
        self.streams.append(
            {
                "robot": robot,
                "stream": stream,
                "batches": found.batches,
                "samples": sum(run.samples for run in found.audit.runs),
                "missing": found.audit.missing,
                "content": found.content,
                "more": found.more,
                "problem": found.problem,
                "copied_batches": batches,
                "copied_hours": hours,
            }
        )
        if found.problem:
            self.problems.append(f"{robot} {stream}: {found.problem}")
        if not self._quiet:
            _show(self.streams[-1])

    def _files(self, plan: Plan) -> None:
        from iort_station.fleet import files  # noqa: PLC0415 - as above
        from iort_station.migration.files import Files  # noqa: PLC0415 - as above

        both = Files(self._source, self._target)
        title = f"{plan.robot}: {len(plan.files):,} files"
        columns = (DownloadColumn(), TransferSpeedColumn())
        with bar(title, plan.files_bytes, *columns) as progress:
            for file in plan.files if self._units is not None else ():
                if problem := both.copy(file, progress):
                    self._problem(f"{file.key}: {problem}")
                else:
                    self.counts["files"] += 1
                    self.counts["files_bytes"] += file.size
        there = {one.key for one in files.listed(self._target, plan.robot)}
        here = list(files.listed(self._source, plan.robot))
        if lacking := [one for one in here if one.key not in there]:
            size = decimal(sum(one.size for one in lacking))
            self._problem(f"{plan.robot}: the target lacks {len(lacking):,} files of {size}: move again")
        for key in both.different([one for one in here if one.key in there]):
            self._problem(f"{key}: another file in the target")

    def _problem(self, text: str) -> None:
        self.problems.append(text)
        if not self._quiet:
            out.print(text, style="red", soft_wrap=True)


def _target(source: Cloud, to: str, profile: str | None, region: str | None) -> Cloud:
    if to == AWS:
        try:
            return Cloud(namespace=source.namespace, profile=profile, region=region).check()
        except StationError as error:
            here = str(error).replace("--region", "--to-region").replace("--profile", "--to-profile")
            raise StationError(f"the target: {here}") from error
    path = Path(to).expanduser()
    path = path / EMBEDDED.name if path.is_dir() else path
    return CloudOptions(source.namespace, None, None, local=True, embedded=path).cloud()


def _show_plan(plan: Plan, *, with_files: bool) -> None:
    """A line for a robot: what there is to do."""
    parts = [_number(len(plan.streams), "stream"), _number(plan.hours, "archived hour")]
    if plan.files:
        what = f"{_number(len(plan.files), 'file')} of {decimal(plan.files_bytes)}"
        parts.append(what if with_files else f"{what} stay here, by --no-files")
    if plan.files_there:
        parts.append(f"{_number(plan.files_there, 'file')} there already")
    out.print(f"{plan.robot}: {plan.registered}; {', '.join(parts)}", soft_wrap=True)


def _show(one: dict[str, Any]) -> None:
    has = f"{one['batches']:,} batches, {one['samples']:,} samples, {one['missing']:,} missing"
    copied = f"copied {one['copied_batches']:,} batches, {one['copied_hours']:,} archived hours"
    more = f"; the target has {one['more']:,} more" if one["more"] else ""
    out.print(
        f"{one['robot']} {one['stream']}: {has}; {copied}; "
        + (one["problem"] or f"the same, {one['content'][:12]}{more}"),
        style="red" if one["problem"] else None,
        soft_wrap=True,
    )


def _show_end(moving: _Moving, plans: list[Plan]) -> None:
    counts = moving.counts
    out.print(
        f"{_number(len(plans), 'robot')}, {counts['registered']} new in the target; "
        f"{_number(len(moving.streams), 'stream')}; copied {_number(counts['findings'], 'finding or note')}, "
        f"{_number(counts['quarantined'], 'quarantined message')}, {_number(counts['files'], 'file')} of "
        f"{decimal(counts['files_bytes'])}; {_number(counts['bundles'], 'bundle')} made",
        soft_wrap=True,
    )
    if moving.problems:
        out.print(_number(len(moving.problems), "problem"), style="red")


def _number(count: int, what: str) -> str:
    return f"{count:,} {what if count == 1 else what.replace(' or', 's or') + 's'}"
