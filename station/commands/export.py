"""`iort export`: the data as files that other tools open."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from station.commands.options import From, Last, Range, Robot, To
from station.errors import StationError
from station.progress import reading, say

if TYPE_CHECKING:
    from station.blocks import Block
    from station.cloud import Cloud
    from station.recordings import Recording
    from station.selection import Selection

commands = typer.Typer()


@commands.command("export")
def export(
    context: typer.Context,
    robot: Robot,
    streams: Annotated[list[str], typer.Argument(help="One stream or more, such as vesc.")],
    output: Annotated[Path, typer.Option("--output", "-o", help="The file to write: .mcap or .bag.")],
    start: From = None,
    end: To = None,
    last: Last = None,
) -> None:
    """Write a recording: MCAP, which Foxglove opens, or a ROS 1 bag, which rosbag plays.

    The messages have the type that the robot's source read them as, where it said so; otherwise one made
    of the fields. Stamps are the samples' times, to the microsecond; headers have the frame_id that they
    had, and are numbered anew. For CSV and Parquet: iort query.
    """
    # numpy takes longer to load than most commands to run.
    from station import recordings  # noqa: PLC0415 - see above
    from station.selection import select  # noqa: PLC0415 - as above

    kind = recordings.KINDS.get(output.suffix)
    if kind is None:
        raise StationError(f"{output}: allowed is a file ending in {' or '.join(recordings.KINDS)}")
    cloud, when = context.obj.cloud(), Range.of(start, end, last)
    with kind(output) as file:
        written = [
            _write(cloud, select(robot, stream, when.start_us, when.end_us), file)
            for stream in dict.fromkeys(streams)
        ]
        if not any(written):
            raise StationError(f"there is nothing to export; {output} is not written")


def _write(cloud: Cloud, selection: Selection, file: Recording) -> int:
    """How many messages were written."""
    from station import data, inventory, messages  # noqa: PLC0415 - as above
    from station.stored import Refused  # noqa: PLC0415 - as above

    refused = Refused()
    robot, stream = selection.robot, selection.stream
    with reading(f"{robot} {stream}", selection.start_us, selection.end_us) as progress:
        blocks = data.samples(cloud, selection, refused=refused, progress=progress)
        first = next(blocks, None)
        if first is None:
            inventory.check_there(cloud, robot, stream)
            say(f"{robot} {stream}: no samples in this range")
            return 0
        kind, frames = messages.said(cloud, selection)
        made = kind or messages.made_of(stream, first.columns)
        maker = messages.Maker(made, list(first.columns), own=kind is None, frames=frames)
        written = file.add(maker, _all(first, blocks))
    if refused.count:
        say(f"{refused.count} stored items are no batches and were left out; the first: {refused.reason}")
    say(f"{robot} {stream}: {written:,} messages of {maker.kind.kind} on {maker.kind.topic}")
    if kind is None:
        say(f"{robot} has not said what {stream} is made of, so the type is made of its fields")
    if maker.lacking:
        say(f"not in the samples, so zero or empty: {', '.join(maker.lacking)}")
    if maker.foreign:
        say(f"not in the type, so left out: {', '.join(maker.foreign)}")
    return written


def _all(first: Block, rest: Iterator[Block]) -> Iterator[Block]:
    yield first
    yield from rest
