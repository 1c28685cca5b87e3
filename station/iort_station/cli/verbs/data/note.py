"""`iort note`: what people wrote about a robot."""

from __future__ import annotations

import time
from typing import Annotated

import typer

from iort_contract.messages.analysis import MAX_NOTE_CHARACTERS, Note
from iort_station.cli.console import errors, out, print_json
from iort_station.cli.options import AsJson, Robot, When, ranged
from iort_station.cli.words import examples, say
from iort_station.data import findings as stored
from iort_station.errors import UsageError
from iort_station.fleet import registry
from iort_station.operations.alarms import user
from iort_station.times import iso_s, stamped, time_us

commands = typer.Typer()


@commands.command(
    "note",
    epilog=examples('note car7 "changed tyre"', 'note car7 "hit the wall" --at -10m', "note car7 --last 7d"),
)
@ranged
def note(
    context: typer.Context,
    robot: Robot,
    when: When,
    text: Annotated[
        str | None, typer.Argument(help=f"The note, at most {MAX_NOTE_CHARACTERS} characters. Default: list.")
    ] = None,
    at: Annotated[
        str | None, typer.Option(metavar="TIME", help="The time that it is about. Default: now.")
    ] = None,
    by: Annotated[str | None, typer.Option(help="Who writes it. Default: you.")] = None,
    remove: Annotated[str | None, typer.Option(metavar="ID", help="Delete the note of this id.")] = None,
    count: Annotated[int, typer.Option(min=1, max=10_000, help="The most to list; the newest.")] = 50,
    as_json: AsJson = False,
) -> None:
    """Write a note about a robot, or list its notes, the newest first.

    The page marks them in the robot's history, and lists them in Insights.
    """
    cloud, within = context.obj.cloud(), when.range()
    if text is not None and remove is not None:
        raise UsageError("give a text to write, or --remove")
    if text is None and (at is not None or by is not None):
        raise UsageError("--at and --by need a text to write")
    if remove is not None:
        stored.remove_note(cloud, robot, remove)
        say(f"note {remove} of {robot} is deleted")
        return
    if text is not None:
        t_us = None if at is None else time_us(at, time.time_ns() // 1000)
        found = [stored.write_note(cloud, robot, text, by=user() if by is None else by, t_us=t_us)]
    else:
        registry.get(cloud, robot)
        found = stored.notes(cloud, robot, within.start_us, within.end_us, most=count)
    if as_json:
        print_json([_as_json(one) for one in found])
        return
    for one in found:
        out.print(f"{iso_s(one.t_us)}  {one.id}  {one.by}: {one.text}", soft_wrap=True)
    if not found:
        errors.print(f"no notes about {robot} in this range")


def _as_json(one: Note) -> dict[str, object]:
    return {"id": one.id, "robot": one.robot, **stamped("time", one.t_us), "by": one.by, "text": one.text}
