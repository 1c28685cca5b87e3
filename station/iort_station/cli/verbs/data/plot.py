"""`iort plot`: pictures of what was recorded."""

from __future__ import annotations

from dataclasses import replace
from enum import Enum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from iort_station.cli.options import Every, From, Last, Range, Robot, Stream, To, names
from iort_station.cli.progress import reading, say
from iort_station.errors import StationError

if TYPE_CHECKING:
    from iort_station.cli.plots import Run
    from iort_station.cloud import Cloud

commands = typer.Typer()
_PANELS = 4
_USUAL = {"vesc": ("speed_mps", "current_motor", "voltage_input", "temperature_pcb")}


class Kind(str, Enum):
    """What a picture shows."""

    time = "time"
    trajectory = "trajectory"
    distribution = "distribution"


class Align(str, Enum):
    """What several runs have in common."""

    time = "time"
    start = "start"


@commands.command("plot")
def plot(
    context: typer.Context,
    robot: Robot,
    stream: Stream,
    output: Annotated[Path, typer.Option("--output", "-o", help="The picture: .png, .svg or .pdf.")],
    kind: Annotated[
        Kind, typer.Option(help="Fields over time, where it went, or how values are distributed.")
    ] = Kind.time,
    fields: Annotated[str | None, typer.Option(help="Fields to draw, with commas between.")] = None,
    start: From = None,
    end: To = None,
    last: Last = None,
    also: Annotated[
        list[str] | None, typer.Option("--with", help="Another robot; give it again for more.")
    ] = None,
    runs: Annotated[
        list[str] | None,
        typer.Option("--run", help="A run's range, FROM/TO; give it again for more, instead of --from."),
    ] = None,
    align: Annotated[
        Align, typer.Option(help="Draw several runs by the clock, or from their start.")
    ] = Align.time,
    where: Annotated[str | None, typer.Option(help="Samples to draw, as in iort query.")] = None,
    every: Every = None,
) -> None:
    """Draw fields over time, the trajectory or the distribution, of one robot or several.

    A trajectory needs a stream with a position: none is made up from speeds. Latitudes and longitudes are
    drawn as metres to the east and north of the first place known.
    """
    # Together they take longer to load than most commands to run.
    from iort_station.cli import plots  # noqa: PLC0415 - see above

    cloud = context.obj.cloud()
    if runs and (start, end, last) != (None, None, None):
        raise StationError("give either --run or --from, --to and --last")
    ranges = [_run(run) for run in runs] if runs else [Range.of(start, end, last)]
    asked = names(fields)
    drawn: list[Run] = []
    for name in dict.fromkeys([robot, *(also or ())]):
        for within in ranges:
            found = _read(cloud, name, stream, within, asked, where, every)  # fmt: skip
            if not len(found.result):
                say(f"{name} {stream}: no samples in this range")
                continue
            label = f"{name}, {plots.when(int(found.result.times_us[0]))} UTC" if runs else name
            drawn.append(found._replace(name=label))
    if not drawn:
        raise StationError("there is nothing to draw")
    if kind is Kind.trajectory:
        figure = plots.trajectory(drawn)
    else:
        wanted = asked or _chosen(drawn[0], stream)
        if kind is Kind.time:
            figure = plots.over_time(drawn, wanted, from_start=align is Align.start)
        else:
            figure = plots.distribution(drawn, wanted)
    plots.save(figure, output)
    say(f"{output}: {sum(len(run.result) for run in drawn):,} samples")


def _read(
    cloud: Cloud,
    robot: str,
    stream: str,
    within: Range,
    fields: list[str] | None,
    where: str | None,
    every: str | None,
) -> Run:
    from iort_station import data  # noqa: PLC0415 - as above
    from iort_station.cli.plots import Run  # noqa: PLC0415 - as above
    from iort_station.data import inventory  # noqa: PLC0415 - as above
    from iort_station.data.conditions import derive  # noqa: PLC0415 - as above

    with reading(f"{robot} {stream}", within.start_us, within.end_us) as progress:
        result = data.query(
            cloud,
            robot,
            stream,
            within.start_us,
            within.end_us,
            fields=fields,
            where=where,
            every=every,
            progress=progress,
        )
    columns = dict(result.columns)
    if fields is None and "speed" in columns:
        columns |= derive(columns, inventory.vehicle_of(cloud, robot))
    return Run(robot, replace(result, columns=columns))


def _chosen(run: Run, stream: str) -> list[str]:
    """What to draw of a stream when nobody says."""
    from iort_station.cli import plots  # noqa: PLC0415 - as above

    there = plots.numeric(run.result)
    usual = [name for name in _USUAL.get(stream, ()) if name in there]
    return usual or there[:_PANELS]


def _run(text: str) -> Range:
    first, separator, last = text.partition("/")
    if not separator:
        raise StationError(f"run {text!r}: allowed is FROM/TO, such as 2026-05-04T10:00Z/2026-05-04T10:05Z")
    return Range.of(first, last, None)
