"""`iort replay-errors`: put rejected messages back."""

from __future__ import annotations

from collections import Counter
from typing import Annotated

import typer

from iort_station.cli.console import errors, out, print_json
from iort_station.cli.options import AsJson, DryRun, OneRobot, When, ranged
from iort_station.cli.progress import bar
from iort_station.cli.verbs.operations.errors import as_fields, entries
from iort_station.cli.words import examples
from iort_station.operations import quarantine
from iort_station.operations.quarantine import Fate

commands = typer.Typer()


@commands.command("replay-errors", epilog=examples("replay-errors --robot car7 --dry-run"))
@ranged
def replay_errors(
    context: typer.Context,
    when: When,
    robot: OneRobot = None,
    dry_run: DryRun = False,
    again: Annotated[
        bool, typer.Option("--again", help=f"Also messages replayed {quarantine.MAX_REPLAYS} times already.")
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Process rejected recordings again, and delete those that arrive.

    Exit status 1 if any fails again.
    """
    within = when.range()
    cloud = context.obj.cloud()
    if not dry_run and (moved := quarantine.recover(cloud)):
        errors.print(f"{moved} messages that the table did not take are on the way to it again")
    found = sorted(entries(cloud, robot, within), key=lambda entry: (entry.first_ms, entry.id))
    outcomes = []
    with bar("putting back", len(found)) as progress:
        for outcome in quarantine.replay(cloud, found, dry_run=dry_run, again=again):
            outcomes.append(outcome)
            progress(1)
    if as_json:
        print_json([{**as_fields(o.letter), "fate": o.fate.value, "detail": o.detail} for o in outcomes])
    else:
        for outcome in outcomes:
            if outcome.fate not in (Fate.REPLAYED, Fate.NOT_FOR_REPLAY):
                detail = f": {outcome.detail}" if outcome.detail else ""
                line = f"{outcome.letter.id}  {outcome.letter.robot}  {outcome.fate.value}{detail}"
                out.print(line, soft_wrap=True)
        counts = Counter(outcome.fate for outcome in outcomes)
        out.print(", ".join(f"{n} {fate.value}" for fate, n in counts.items()) or "nothing in quarantine")
    if any(outcome.fate is Fate.FAILED for outcome in outcomes):
        raise typer.Exit(1)
