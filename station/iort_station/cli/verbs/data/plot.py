"""`iort plot`: pictures of recorded samples."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from iort_station.cli.console import tell
from iort_station.cli.options import (
    SHORT,
    AsJson,
    Every,
    Fields,
    Force,
    Range,
    Robot,
    Stream,
    When,
    Where,
    names,
    ranged,
    to_file,
)
from iort_station.cli.progress import reading
from iort_station.cli.words import examples, say, say_archived, say_refused
from iort_station.cloud import Cloud
from iort_station.errors import StationError, UsageError
from iort_station.fleet import registry
from iort_station.output import check_free
from iort_station.times import between_hours

commands = typer.Typer()


@commands.command(
    "plot",
    epilog=examples(
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
    out: Annotated[Path, to_file("The picture: .png, .svg or .pdf.")],
    kind: Annotated[
        Literal["time", "trajectory", "distribution"],
        typer.Option(help="Fields over time, the way from above, or the distribution of values."),
    ] = "time",
    fields: Fields = None,
    also: Annotated[list[str] | None, typer.Option("--with", help="Another robot; may be repeated.")] = None,
    runs: Annotated[
        list[str] | None,
        typer.Option("--run", help="A run's range, FROM/TO, instead of --from and --to; may be repeated."),
    ] = None,
    align: Annotated[
        Literal["time", "start"], typer.Option(help="Draw several runs by the clock, or from their start.")
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
    ranges = [_run(run) for run in runs] if runs else [when.range(SHORT)]
    cloud = context.obj.cloud()
    wanted = names(fields)
    drawn: list[plots.Run] = []
    for name in dict.fromkeys([robot, *(also or ())]):
        for within in ranges:
            result = _read(cloud, name, stream, within, fields=wanted, where=where, every=every)
            say_refused(result.refused, result.reason)
            if not len(result):
                say(f"{name} {stream}: no samples in this range")
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
    say_archived(archived)


def _read(cloud: Cloud, robot: str, stream: str, within: Range, **asked: Any) -> Any:
    from iort_station import data  # noqa: PLC0415 - as above
    from iort_station.data.selection import derive  # noqa: PLC0415 - as above

    with reading(f"{robot} {stream}", within.start_us, within.end_us) as progress:
        result = data.query(cloud, robot, stream, within.start_us, within.end_us, progress=progress, **asked)
    columns = dict(result.columns)
    if asked["fields"] is None and "speed" in columns:
        columns |= derive(columns, registry.vehicle_of(cloud, robot))
    return replace(result, columns=columns)


def _run(text: str) -> Range:
    first, separator, last = text.partition("/")
    if not separator:
        raise UsageError(
            f"--run must be FROM/TO, for example 2026-05-04T10:00Z/2026-05-04T10:05Z, got {text!r}"
        )
    return When(first, last).range()
