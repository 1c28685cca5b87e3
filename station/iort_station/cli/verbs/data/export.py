"""`iort export`: the data as files that other tools open."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from iort_station.cli.options import From, Last, Range, Robot, To
from iort_station.cli.progress import reading, say
from iort_station.errors import StationError

if TYPE_CHECKING:
    from iort_contract.messages.message_type import MessageType
    from iort_station.cloud import Cloud
    from iort_station.data.selection import Selection
    from iort_station.recordings.recordings import Recording, Write

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

    ROS messages are written byte for byte as they were published, whatever their type. Samples that are no
    messages (of a simulated car, a serial line, a selection of fields) are made into some, of the type that
    their source said, or of their fields. For CSV and Parquet: iort query.
    """
    # numpy takes longer to load than most commands to run.
    from iort_station.data.selection import select  # noqa: PLC0415 - as above
    from iort_station.recordings import recordings  # noqa: PLC0415 - see above

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
    from iort_station.data import inventory  # noqa: PLC0415 - as above
    from iort_station.fleet import files  # noqa: PLC0415 - as above
    from iort_station.recordings import messages  # noqa: PLC0415 - as above
    from iort_station.recordings.published import Export  # noqa: PLC0415 - as above

    robot, stream = selection.robot, selection.stream
    said = {name: kind for name, (_, kind) in messages.types(cloud, robot, stream).items()}
    export = Export(cloud, selection, said, lambda key: files.content(cloud, key))
    counts: dict[str, int] = {}
    writers: dict[str, Write] = {}
    with reading(f"{robot} {stream}", selection.start_us, selection.end_us) as progress:
        for t_us, name, raw in export.messages(progress):
            if name not in writers:
                kind = export.types[name]
                writers[name] = file.topic(kind.topic, kind.kind, kind.definition, kind.md5sum)
            writers[name](t_us * 1000, raw)
            counts[name] = counts.get(name, 0) + 1
    for name, count in counts.items():
        kind = export.types[name]
        say(f"{robot} {stream}: {count:,} messages of {kind.kind} on {kind.topic}, as they were published")
        if name not in said:
            say("  its definition is not stored, so topic, comments and constants are not the publisher's")
    if export.refused.count:
        say(f"{export.refused.count} stored items cannot be exported; the first: {export.refused.reason}")
    if export.empty:
        say(f"{export.empty} messages have an empty array: their content was not kept, or is not uploaded")
    made = _make(cloud, selection, file, said) if export.others else 0
    if not counts and not made:
        inventory.check_there(cloud, robot, stream)
        say(f"{robot} {stream}: no samples in this range")
    return sum(counts.values()) + made


def _make(cloud: Cloud, selection: Selection, file: Recording, said: Mapping[str, MessageType]) -> int:
    """Write messages made of the samples that are none; how many."""
    from iort_station import data  # noqa: PLC0415 - as above
    from iort_station.data.batches import RefusedItems  # noqa: PLC0415 - as above
    from iort_station.recordings import messages  # noqa: PLC0415 - as above

    robot, stream = selection.robot, selection.stream
    blocks = data.samples(cloud, selection, refused=RefusedItems(), messages=False)
    first = next(blocks, None)
    if first is None:
        return 0
    # Of topics that share a stream nobody can tell whose a selection of fields is.
    shared = len({kind.topic for kind in said.values()}) > 1
    kind = None if shared else next(iter(reversed(list(said.values()))), None)
    makers: dict[tuple[tuple[str, str], ...], tuple[messages.Maker, Write]] = {}
    numbers, written = itertools.count(), 0
    for block in itertools.chain([first], blocks):
        # Fields come and go while a robot drives, and what a field holds may change.
        shape = tuple(sorted((name, column.dtype.kind) for name, column in block.columns.items()))
        if shape not in makers:
            made = kind or messages.made_of(stream, block.columns)
            maker = messages.Maker(made, list(block.columns), own=kind is None, numbers=numbers)
            topic = file.topic(maker.kind.topic, maker.kind.kind, maker.definition, maker.md5sum)
            makers[shape] = maker, topic
        maker, write = makers[shape]
        for t_ns, message in maker.messages(block):
            write(t_ns, message)
            written += 1
    say(f"{robot} {stream}: {written:,} messages of {maker.kind.kind} on {maker.kind.topic}, made of samples")
    if shared:
        say(f"several topics of {robot} share {stream}, so the type is made of the fields selected")
    elif kind is None:
        say(f"{robot} has not said what {stream} is made of, so the type is made of its fields")
    if len(makers) > 1 and kind is None:
        say(f"its fields changed, so there are {len(makers)} types of that name")
    lacking = {name for maker, _ in makers.values() for name in maker.lacking}
    foreign = {name for maker, _ in makers.values() for name in maker.foreign}
    if lacking:
        say(f"not in the samples, or not in all, so zero or empty: {', '.join(sorted(lacking))}")
    if foreign:
        say(f"not in the type, so left out: {', '.join(sorted(foreign))}")
    return written
