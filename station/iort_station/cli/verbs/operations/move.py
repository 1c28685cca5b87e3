"""`iort move`: robots and what they have recorded, from one cloud into another."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from iort_station.cli import completion
from iort_station.cli.cloud_options import CloudOptions
from iort_station.cli.console import errors, out, print_json
from iort_station.cli.options import AsJson, DryRun
from iort_station.cli.words import examples, say
from iort_station.cloud import EMBEDDED, Cloud
from iort_station.fleet import registry

if TYPE_CHECKING:
    from iort_station.operations.move import Compared, Copied

commands = typer.Typer()
AWS = "aws"


@commands.command("move", epilog=examples("move --to aws --to-profile lab", "move --to ~/cloud-2 car7"))
def move_(
    context: typer.Context,
    to: Annotated[
        str,
        typer.Option(metavar="aws|FOLDER", help="An AWS account, or the folder of another embedded cloud."),
    ],
    names: Annotated[
        list[str] | None,
        typer.Argument(metavar="ROBOT", help="Default: every robot.", autocompletion=completion.robots),
    ] = None,
    to_profile: Annotated[str | None, typer.Option(help="The AWS profile of --to aws.")] = None,
    to_region: Annotated[str | None, typer.Option(help="The AWS region of --to aws.")] = None,
    bundles: Annotated[
        Path | None,
        typer.Option(help="Make a certificate for each robot there, in a bundle in this folder."),
    ] = None,
    units: Annotated[
        int,
        typer.Option(min=1, help="Speed in write units of DynamoDB (1 KB) a second. A stream takes 1,000."),
    ] = 500,
    dry_run: DryRun = False,
    as_json: AsJson = False,
) -> None:
    """Copy robots into another deployment: registry, archive, stored batches, findings and notes.

    The source stays as it is. A second run copies what is new, and an interrupted one goes on. Then both
    sides are compared, batch by batch and by their audits; --dry-run only compares. A moved robot has no
    certificate there: it claims one, or gets a bundle by --bundles. Exit status 1 if something differs. See
    docs/how-to/move.md.
    """
    # numpy takes longer to load than TAB may take.
    from iort_station.data import inventory  # noqa: PLC0415 - see above
    from iort_station.operations import move  # noqa: PLC0415 - as above

    source = context.obj.cloud()
    target = _target(source, to, to_profile, to_region)
    move.check(source, target)
    chosen = sorted({registry.checked(name) for name in names or ()}) or sorted(registry.presence(source))
    for robot in names or ():
        # A robot that was removed has samples, and no row.
        inventory.check_recorded(source, robot)
    told: list[dict[str, Any]] = []
    registered = findings = 0
    if not dry_run:
        registered = sum(move.register(source, target, robot, bundles) for robot in chosen)
        move.copy_tags(source, target, chosen)
        findings = sum(move.copy_findings(source, target, robot) for robot in chosen)
    for robot in chosen:
        for stream in inventory.known(source, robot):
            with errors.status(f"{robot} {stream}") as status:
                read = _Reading(status.update, f"{robot} {stream}")
                copied = None
                if not dry_run:
                    copied = move.copy(source, target, robot, stream, units_per_s=units, progress=read.tell)
                found = move.compare(source, target, robot, stream, read.tell)
            if found.source.batches or found.target.batches:
                told.append(_as_json(robot, stream, copied, found))
                if not as_json:
                    _show(told[-1])
    if as_json:
        print_json({"streams": told, "registered": registered, "findings": findings})
    else:
        robots = f"{len(chosen)} robots, {registered} of them new in the target"
        out.print(f"{robots}, {len(told)} streams, {findings} findings, analysed drives and notes")
    if registered and bundles is None:
        say("each new robot still needs a certificate there: `iort robots claim ROBOT`, docs/how-to/move.md")
    raise typer.Exit(1 if any(one["problem"] for one in told) else 0)


class _Reading:
    """Tells how many batches have been read."""

    def __init__(self, show: Any, what: str) -> None:
        self._show, self._what, self._read = show, what, 0

    def tell(self, batches: int) -> None:
        self._read += batches
        self._show(f"{self._what}: {self._read:,} batches read")


def _target(source: Cloud, to: str, profile: str | None, region: str | None) -> Cloud:
    if to == AWS:
        return Cloud(namespace=source.namespace, profile=profile, region=region).check()
    path = Path(to).expanduser()
    path = path / EMBEDDED.name if path.is_dir() else path
    return CloudOptions(source.namespace, None, None, local=True, embedded=path).cloud()


def _as_json(robot: str, stream: str, copied: Copied | None, found: Compared) -> dict[str, Any]:
    audit = found.source.audit
    return {
        "robot": robot,
        "stream": stream,
        "copied_batches": copied.batches if copied is not None else 0,
        "copied_hours": copied.hours if copied is not None else 0,
        "left_hours": copied.left if copied is not None else 0,
        "batches": found.source.batches,
        "samples": sum(run.samples for run in audit.runs),
        "missing": audit.missing,
        "content": found.source.content,
        "problem": found.problem,
    }


def _show(one: dict[str, Any]) -> None:
    has = f"{one['batches']:,} batches, {one['samples']:,} samples, {one['missing']:,} missing"
    copied = f"copied {one['copied_batches']:,} batches, {one['copied_hours']:,} archived hours"
    text = f"{one['robot']} {one['stream']}: {has}; {copied}; "
    problem = one["problem"]
    if one["left_hours"]:
        problem += f"; {one['left_hours']:,} hours are left: the target has another object of their day"
    out.print(
        text + (problem or f"the same, {one['content'][:12]}"),
        style="red" if problem else None,
        soft_wrap=True,
    )
