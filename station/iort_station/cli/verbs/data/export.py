"""`iort export`: the data as files that other tools open."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from iort_contract.catalog.streams import ACCOUNT_STREAM, TYPES_STREAM
from iort_station.cli.console import tell
from iort_station.cli.options import SHORT, AsJson, Force, Robot, When, ranged, to_file
from iort_station.cli.progress import reading
from iort_station.cli.words import examples, say, say_archived
from iort_station.errors import StationError, UsageError
from iort_station.output import check_free
from iort_station.times import between_hours

commands = typer.Typer()

# Streams for the station alone, not for people.
_BOOKKEEPING = {ACCOUNT_STREAM, TYPES_STREAM}


@commands.command(
    "export",
    epilog=examples("export car7 vesc --last 10m --out car7.mcap", "export car7 --last 10m --out all.mcap"),
)
@ranged
def export(
    context: typer.Context,
    robot: Robot,
    when: When,
    out: Annotated[Path, to_file("The file to write: .mcap or .bag.")],
    streams: Annotated[
        list[str] | None, typer.Argument(help="The streams, for example vesc. Default: all.")
    ] = None,
    force: Force = False,
    as_json: AsJson = False,
) -> None:
    """Write a recording: MCAP, which Foxglove opens, or a ROS 1 bag, which rosbag plays.

    ROS messages of every type are written byte for byte as they were published. Other samples (of a simulated
    car, a serial line, a selection of fields) become messages of the type that their source gave, or of their
    fields. For CSV and Parquet, use iort query.
    """
    # numpy takes longer to load than most commands to run.
    from iort_analysis.archive.stored import Origin  # noqa: PLC0415 - as above
    from iort_station.data import bags  # noqa: PLC0415 - as above
    from iort_station.data.export import write  # noqa: PLC0415 - as above
    from iort_station.data.inventory import check_recorded, check_there  # noqa: PLC0415 - see above
    from iort_station.data.selection import select  # noqa: PLC0415 - as above

    kind = bags.KINDS.get(out.suffix)
    if kind is None:
        raise UsageError(f"the file must end in {' or '.join(bags.KINDS)}, got {out}")
    check_free(out, force=force)
    within = when.range(SHORT)
    cloud = context.obj.cloud()
    if not streams:
        streams = [name for name in check_recorded(cloud, robot) if name not in _BOOKKEEPING]
    written, origin = 0, Origin()
    with kind(out, force=force) as file:
        for stream in dict.fromkeys(streams):
            selection = select(robot, stream, within.start_us, within.end_us)
            with reading(f"{robot} {stream}", within.start_us, within.end_us) as progress:
                written += write(cloud, selection, file, origin=origin, say=say, progress=progress)
        if not written:
            for stream in streams:
                check_there(cloud, robot, stream)
            raise StationError(f"there are no samples to export; {out} is not written")
    archived = origin.within(within.start_us, within.end_us).told()
    told = {"file": str(out), "messages": written, "archive": archived and between_hours(archived)}
    tell(told, f"{out}: {written:,} messages", as_json=as_json)
    say_archived(archived)
