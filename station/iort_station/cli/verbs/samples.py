"""`iort query`, `export` and `plot`: what a robot has recorded, as text, as files, as pictures."""

from __future__ import annotations

import sys
import time
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, TextIO

import typer

from iort_contract.catalog.streams import ACCOUNT_STREAM, TYPES_STREAM
from iort_contract.catalog.vesc import NO_SENSOR_DEGC
from iort_station.cli import options
from iort_station.cli.console import out as out_console
from iort_station.cli.console import reading, tell
from iort_station.cli.options import (
    AsJson,
    Every,
    Fields,
    Force,
    Robot,
    Stream,
    When,
    Where,
    argument,
    option,
    ranged,
)
from iort_station.cli.verbs.lerobot import Learning, learned
from iort_station.cli.verbs.lerobot import export as dataset
from iort_station.cloud import Cloud
from iort_station.errors import StationError, UsageError
from iort_station.fleet import registry
from iort_station.output import check_free, whole
from iort_station.times import between_hours

if TYPE_CHECKING:
    from iort_station.data import Result

commands = typer.Typer()


Format = Literal["table", "csv", "jsonl", "parquet"]
# A file's format, unless --format says another.
_ENDINGS: dict[str, Format] = {
    ".csv": "csv",
    ".jsonl": "jsonl",
    ".ndjson": "jsonl",
    ".parquet": "parquet",
    ".txt": "table",
}


@commands.command(
    "query",
    epilog=options.examples(
        "query car7 vesc --last 10m --fields speed_mps,voltage_input",
        "query car7 vesc --last 1h --where 'speed_mps > 1.2' --every 1s",
        "query car7 vesc --last 7d --out car7.parquet",
    ),
)
@ranged
def query(
    context: typer.Context,
    robot: Robot,
    stream: Stream,
    when: When,
    fields: Fields = None,
    where: Where = None,
    every: Every = None,
    summary: Annotated[bool, option("The summary of each second instead of samples.", "--summary")] = False,
    form: Annotated[
        Format | None, option("The output format. Default: the ending of --out, or else a table.", "--format")
    ] = None,
    as_json: Annotated[bool, option("The same as --format jsonl.", "--json")] = False,
    raw: Annotated[
        bool, option("Leave formulas and control characters in the texts of CSV.", "--raw")
    ] = False,
    out: Annotated[Path | None, option("The file to write. Default: standard output.", "--out", "-o")] = None,
    force: Force = False,
    on: Annotated[
        Literal["client", "lambda"],
        option("Select samples on this machine, or in the cloud's query function."),
    ] = "client",
    source: Annotated[
        Literal["auto", "table", "archive"],
        option("Read the table and, of what expires, the archive; or only one of them."),
    ] = "auto",
    scan: Annotated[bool, option("Scan the whole table, which is slow; for comparison.", "--scan")] = False,
) -> None:
    """Print recorded samples, combined samples, or the summary of each second.

    The default range is the last five minutes. A range includes its start and excludes its end.
    """
    # numpy takes longer to load than most commands to run.
    from iort_station import data  # noqa: PLC0415 - see above
    from iort_station.data import inventory  # noqa: PLC0415 - see above

    form = "jsonl" if as_json else form or _form_of(out)
    if form == "parquet" and out is None and sys.stdout.isatty():
        raise UsageError("a terminal cannot show Parquet: give --out FILE, or use a pipe")
    if out is not None:
        check_free(out, force=force)
    within = when.range(options.SHORT)
    cloud = context.obj.cloud()
    began = time.monotonic()
    with reading(f"{robot} {stream}", within.start_us, within.end_us) as progress:
        result = data.query(
            cloud,
            robot,
            stream,
            within.start_us,
            within.end_us,
            fields=options.names(fields),
            where=where,
            every=every,
            summary=summary,
            on=on,
            source=source,
            scan=scan,
            progress=progress,
        )
    took_s = time.monotonic() - began
    if out is None:
        _write(result, form, sys.stdout, raw=raw)
    else:
        with whole(out, force=force) as part, part.open("w", encoding="utf-8", newline="") as file:
            _write(result, form, file, raw=raw)
    options.say_refused(result.refused, result.reason)
    if result.absent:
        counted = ", ".join(f"{name} {count:,}" for name, count in sorted(result.absent.items()))
        options.say(f"null because the sensor is missing ({NO_SENSOR_DEGC:g} degC and below): {counted}")
    options.say(f"{len(result):,} {'seconds' if summary and not every else 'samples'} in {took_s:.2f} s")
    options.say_archived(result.origin.told())
    if not len(result) and (extent := inventory.extent(cloud, robot, stream)):
        options.say(f"none in this range; {robot} has {stream} from {extent[0]} to {extent[1]}")


def _form_of(out: Path | None) -> Format:
    """The format that a file's ending names; a device, a pipe and the standard output get a table."""
    if out is None or (out.exists() and not out.is_file()):
        return "table"
    if out.suffix in {".mcap", ".bag"}:
        raise UsageError(f"iort export writes {out.suffix}, iort query {', '.join(_ENDINGS)}; got {out}")
    if out.suffix not in _ENDINGS:
        raise UsageError(
            f"the file must end in {', '.join(_ENDINGS)}, or --format must say what it is; got {out}"
        )
    return _ENDINGS[out.suffix]


def _write(result: Result, form: Format, file: TextIO, *, raw: bool) -> None:
    from iort_station.cli import tables  # noqa: PLC0415 - as above
    from iort_station.data import tabular  # noqa: PLC0415 - as above

    if form == "parquet":
        tabular.to_parquet(result, file.buffer)
    elif form == "csv":
        tabular.to_csv(result, file, raw=raw)
    elif form == "jsonl":
        tabular.to_json_lines(result, file)
    else:
        shown = tables.write(result, file, out_console.width if file.isatty() else None)
        if shown.rows < len(result):
            options.say(f"{shown.rows} of {len(result):,} shown; a pipe or --out FILE.csv gets every one")
        if shown.left_out:
            left_out = ", ".join(shown.left_out)
            options.say(f"no room for {left_out}: choose with --fields, or use --out FILE.csv")


# `iort export`: the data as files that other tools open.


# Streams for the station alone, not for people.
_BOOKKEEPING = {ACCOUNT_STREAM, TYPES_STREAM}


@commands.command(
    "export",
    epilog=options.examples(
        "export car7 vesc --last 10m --out car7.mcap",
        "export car7 --last 10m --out all.mcap",
        "export car7 --last 10m --out ride/",
        "export car7 --format lerobot --episodes runs --action vesc.duty_cycle --out dataset/",
    ),
)
@learned
@ranged
def export(
    context: typer.Context,
    robot: Robot,
    when: When,
    learning: Learning,
    out: Annotated[Path, option("The file to write: .mcap, .bag, or a folder of ROS 2.", "--out", "-o")],
    streams: Annotated[list[str] | None, argument("The streams, for example vesc. Default: all.")] = None,
    form: Annotated[
        Literal["lerobot"] | None,
        option("Write a dataset for learning. Default: what --out is.", "--format"),
    ] = None,
    ros2: Annotated[bool, option("Write messages of ROS 1 as ROS 2's.", "--ros2")] = False,
    force: Force = False,
    as_json: AsJson = False,
) -> None:
    """Write a recording: MCAP, which Foxglove opens; a ROS 1 bag, which rosbag plays; or a folder of ROS 2.

    A name without an ending is a folder with an SQLite database. `ros2 bag` plays it, and an MCAP that has
    only messages of ROS 2. ROS messages of every type are written byte for byte as they were published. A bag
    has those of ROS 2 in ROS 1's form; a folder, or an MCAP with --ros2, has those of ROS 1 in ROS 2's, which
    loses the seq of headers. Other samples (of a simulated car, a serial line, a selection of fields) become
    messages of the type that their source gave, or of their fields. For CSV and Parquet, use iort query.

    With --format lerobot, drives, runs or incidents become episodes of a dataset of LeRobot 3.0: state and
    action at even steps, cameras as videos.
    """
    if form is not None:
        if streams or ros2 or out.suffix:
            raise UsageError("--format lerobot writes a folder: give neither streams, --ros2 nor an ending")
        dataset(context.obj.cloud(), robot, when.range(), out, learning, force=force, as_json=as_json)
        return
    if learning.given:
        raise UsageError("--episodes, --state, --action, --cameras, --fps and --task need --format lerobot")
    # numpy takes longer to load than most commands to run.
    from iort_analysis.archive.stored import Origin  # noqa: PLC0415 - as above
    from iort_station.data import bags  # noqa: PLC0415 - as above
    from iort_station.data.export import write  # noqa: PLC0415 - as above
    from iort_station.data.inventory import check_recorded, check_there  # noqa: PLC0415 - see above
    from iort_station.data.recorded import select  # noqa: PLC0415 - as above

    kind = partial(bags.mcap, ros2=True) if ros2 and out.suffix == ".mcap" else bags.KINDS.get(out.suffix)
    if kind is None:
        raise UsageError(f"the file must end in .bag or .mcap, and a folder in nothing, got {out}")
    if ros2 and out.suffix == ".bag":
        raise UsageError(f"{out} has messages of ROS 1: --ros2 needs an .mcap or a folder")
    check_free(out, force=force)
    within = when.range(options.SHORT)
    cloud = context.obj.cloud()
    if not streams:
        streams = [name for name in check_recorded(cloud, robot) if name not in _BOOKKEEPING]
    written, origin = 0, Origin()
    with kind(out, force=force) as file:
        for stream in dict.fromkeys(streams):
            selection = select(robot, stream, within.start_us, within.end_us)
            with reading(f"{robot} {stream}", within.start_us, within.end_us) as progress:
                written += write(cloud, selection, file, origin=origin, say=options.say, progress=progress)
        if not written:
            for stream in streams:
                check_there(cloud, robot, stream)
            raise StationError(f"there are no samples to export; {out} is not written")
    archived = origin.within(within.start_us, within.end_us).told()
    told = {"file": str(out), "messages": written, "archive": archived and between_hours(archived)}
    tell(told, f"{out}: {written:,} messages", as_json=as_json)
    options.say_archived(archived)


# `iort plot`: pictures of recorded samples.


@commands.command(
    "plot",
    epilog=options.examples(
        "plot car7 vesc --last 10m --fields speed_mps --out speed.png",
        "plot car7 pose --kind trajectory --last 10m --out track.png",
    ),
)
@ranged
def plot(
    context: typer.Context,
    robot: Robot,
    stream: Stream,
    when: When,
    out: Annotated[Path, option("The picture: .png, .svg or .pdf.", "--out", "-o")],
    kind: Annotated[
        Literal["time", "trajectory", "distribution"],
        option("Fields over time, the way from above, or the distribution of values."),
    ] = "time",
    fields: Fields = None,
    also: Annotated[list[str] | None, option("Another robot; may be repeated.", "--with")] = None,
    runs: Annotated[
        list[str] | None,
        option("A run's range, FROM/TO, instead of --from and --to; may be repeated.", "--run"),
    ] = None,
    align: Annotated[
        Literal["time", "start"], option("Draw several runs by the clock, or from their start.")
    ] = "time",
    where: Where = None,
    every: Every = None,
    force: Force = False,
    as_json: AsJson = False,
) -> None:
    """Draw fields over time, the trajectory or the distribution, of one robot or several.

    A trajectory needs a stream with a position: it is not computed from speeds. Latitudes and longitudes are
    drawn as metres to the east and north of the first known place.
    """
    # Together they take longer to load than most commands to run.
    from iort_analysis.archive.stored import Origin  # noqa: PLC0415 - as above
    from iort_station.cli import plots  # noqa: PLC0415 - see above

    plots.check_ending(out)
    check_free(out, force=force)
    if runs and when != When():
        raise UsageError("give either --run or --from, --to and --last")
    ranges = [_run(run) for run in runs] if runs else [when.range(options.SHORT)]
    cloud = context.obj.cloud()
    wanted = options.names(fields)
    drawn: list[plots.Run] = []
    for name in dict.fromkeys([robot, *(also or ())]):
        for within in ranges:
            result = _read(cloud, name, stream, within, fields=wanted, where=where, every=every)
            options.say_refused(result.refused, result.reason)
            if not len(result):
                options.say(f"{name} {stream}: no samples in this range")
                continue
            label = f"{name}, {plots.when(int(result.times_us[0]))} UTC" if runs else name
            drawn.append(plots.Run(label, result))
    if not drawn:
        raise StationError("there are no samples to draw")
    if kind == "trajectory":
        figure = plots.trajectory(drawn)
    elif kind == "time":
        shown = wanted or plots.usual(drawn[0].result)
        figure = plots.over_time(drawn, shown, from_start=align == "start")
    else:
        figure = plots.distribution(drawn, wanted or plots.usual(drawn[0].result))
    plots.save(figure, out, force=force)
    count = sum(len(run.result) for run in drawn)
    archived = Origin([hour for run in drawn for hour in run.result.origin.hours]).told()
    told = {"file": str(out), "samples": count, "archive": archived and between_hours(archived)}
    tell(told, f"{out}: {count:,} samples", as_json=as_json)
    options.say_archived(archived)


def _read(cloud: Cloud, robot: str, stream: str, within: options.Range, **asked: Any) -> Any:
    from iort_station import data  # noqa: PLC0415 - as above
    from iort_station.data.conditions import derive  # noqa: PLC0415 - as above

    with reading(f"{robot} {stream}", within.start_us, within.end_us) as progress:
        result = data.query(cloud, robot, stream, within.start_us, within.end_us, progress=progress, **asked)
    columns = dict(result.columns)
    if asked["fields"] is None and "speed" in columns:
        columns |= derive(columns, registry.vehicle_of(cloud, robot))
    return replace(result, columns=columns)


def _run(text: str) -> options.Range:
    first, separator, last = text.partition("/")
    if not separator:
        raise UsageError(
            f"--run must be FROM/TO, for example 2026-05-04T10:00Z/2026-05-04T10:05Z, got {text!r}"
        )
    return When(first, last).range()
