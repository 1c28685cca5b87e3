"""Writes a robot's stored samples as messages into a recording."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping

from iort_analysis.archive.stored import Origin, PageProgress
from iort_analysis.samples.batches import RefusedItems
from iort_contract.messages.message_type import ROS2, MessageType
from iort_station import data
from iort_station.cloud import Cloud
from iort_station.data import inventory
from iort_station.data.selection import Selection
from iort_station.fleet import files
from iort_station.recordings import messages
from iort_station.recordings.published import Export
from iort_station.recordings.recordings import Recording, Write

Say = Callable[[str], None]


def write(
    cloud: Cloud,
    selection: Selection,
    file: Recording,
    *,
    origin: Origin | None = None,
    refused: RefusedItems | None = None,
    say: Say = lambda _line: None,
    progress: PageProgress = lambda _more, _last_us: None,
) -> int:
    """Write the messages of a selection and return their number; ``say`` takes lines about the result,
    ``origin`` grows by what comes from the archive, and ``refused`` counts what cannot be exported.

    ROS messages are written as they were published, and those of ROS 2 in its form if ``file`` can hold it.
    Other samples become messages of the type that their source gave, or of their fields.
    """
    robot, stream = selection.robot, selection.stream
    known = {name: kind for name, (_, kind) in messages.types(cloud, robot, stream).items()}
    export = Export(cloud, selection, known, lambda key: files.content(cloud, key), origin)
    counts: dict[str, int] = {}
    writers: dict[str, Write] = {}
    for t_us, name, raw in export.messages(progress):
        if name not in writers:
            kind = export.types[name]
            ros2 = kind.converted_from == ROS2
            writers[name] = file.topic(kind.topic, kind.kind, kind.definition, kind.md5sum, ros2=ros2)
        writers[name](t_us * 1000, raw)
        counts[name] = counts.get(name, 0) + 1
    for name, count in counts.items():
        kind = export.types[name]
        form = "as they were published"
        if kind.converted_from == ROS2:
            form = "of ROS 2, converted to ROS 1 when they were recorded"
            form += " and back for this file" if file.ros2 else ""
        say(f"{robot} {stream}: {count:,} messages of {kind.kind} on {kind.topic}, {form}")
        if name not in known:
            say("  its definition is not stored, so topic, comments and constants are not the publisher's")
    if refused is not None:
        refused.count += export.refused.count
    if export.refused.count:
        say(f"{export.refused.count:,} stored items cannot be exported; the first: {export.refused.reason}")
    if export.empty:
        say(f"{export.empty} messages have an empty array: their content was not kept, or is not uploaded")
    made = _make(cloud, selection, file, known, say) if export.others else 0
    if not counts and not made and not export.refused.count:
        inventory.check_there(cloud, robot, stream)
        say(f"{robot} {stream}: no samples in this range")
    return sum(counts.values()) + made


def _make(
    cloud: Cloud, selection: Selection, file: Recording, known: Mapping[str, MessageType], say: Say
) -> int:
    """Write messages made of the samples that are not ROS messages, and return their number."""
    robot, stream = selection.robot, selection.stream
    blocks = data.samples(cloud, selection, refused=RefusedItems(), messages=False)
    # If topics share a stream, nobody can tell which one a selection of fields belongs to.
    shared = len({kind.topic for kind in known.values()}) > 1
    kind = None if shared else next(iter(reversed(list(known.values()))), None)
    makers: dict[tuple[tuple[str, str], ...], tuple[messages.Maker, Write]] = {}
    numbers, written = itertools.count(), 0
    for block in blocks:
        # While a robot drives, fields come and go, and the kind of a field's values may change.
        shape = tuple(sorted((name, column.dtype.kind) for name, column in block.columns.items()))
        if shape not in makers:
            made = kind or messages.made_of(stream, block.columns)
            maker = messages.Maker(made, list(block.columns), own=kind is None, numbers=numbers)
            topic = file.topic(maker.kind.topic, maker.kind.kind, maker.definition, maker.md5sum)
            makers[shape] = maker, topic
        maker, write_one = makers[shape]
        for t_ns, message in maker.messages(block):
            write_one(t_ns, message)
            written += 1
    if not makers:
        return 0
    made = maker.kind
    say(f"{robot} {stream}: {written:,} messages of {made.kind} on {made.topic}, made of samples")
    if shared:
        say(f"several topics of {robot} share {stream}, so the type is made of the selected fields")
    elif kind is None:
        say(f"{robot} has not sent the type of {stream}, so the type is made of its fields")
    if len(makers) > 1 and kind is None:
        say(f"its fields changed, so there are {len(makers)} types of that name")
    lacking = {name for maker, _ in makers.values() for name in maker.lacking}
    foreign = {name for maker, _ in makers.values() for name in maker.foreign}
    if lacking:
        say(f"missing in some or all samples, so zero or empty: {', '.join(sorted(lacking))}")
    if foreign:
        say(f"not in the type, so left out: {', '.join(sorted(foreign))}")
    return written
