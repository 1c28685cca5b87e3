"""`iort query`: what a robot has recorded."""

from __future__ import annotations

import sys
import time
from contextlib import nullcontext
from enum import Enum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from iort_contract.catalog.derived import DERIVED
from iort_contract.catalog.vesc import NO_SENSOR_DEGC
from iort_station.cli.console import Console
from iort_station.cli.options import Every, From, Last, Range, Robot, Stream, To, names
from iort_station.cli.progress import reading, say
from iort_station.errors import StationError

if TYPE_CHECKING:
    from iort_station.data import Result

commands = typer.Typer()


class Format(str, Enum):
    """The format of the output."""

    table = "table"
    csv = "csv"
    jsonl = "jsonl"
    parquet = "parquet"


class On(str, Enum):
    """Where samples are selected."""

    client = "client"
    lambda_ = "lambda"


@commands.command("query")
def query(
    context: typer.Context,
    robot: Robot,
    stream: Stream,
    start: From = None,
    end: To = None,
    last: Last = None,
    fields: Annotated[
        str | None,
        typer.Option(help=f"Comma-separated fields; {' and '.join(DERIVED)} are derived."),
    ] = None,
    where: Annotated[
        str | None, typer.Option(help="Filter, for example 'speed_mps > 1.2 and fault_code == 0'.")
    ] = None,
    every: Every = None,
    summary: Annotated[
        bool, typer.Option("--summary", help="The summary of each second instead of samples.")
    ] = False,
    form: Annotated[Format, typer.Option("--format", help="The output format.")] = Format.table,
    as_json: Annotated[bool, typer.Option("--json", help="The same as --format jsonl.")] = False,
    raw: Annotated[
        bool, typer.Option("--raw", help="Leave formulas and control characters in the texts of CSV.")
    ] = False,
    output: Annotated[
        Path | None, typer.Option("--output", "-o", help="The output file. Default: standard output.")
    ] = None,
    on: Annotated[
        On, typer.Option(help="Select samples on this machine, or in the cloud's query function.")
    ] = On.client,
    scan: Annotated[
        bool,
        typer.Option("--scan", help="Scan the whole table, which is slow; for comparison."),
    ] = False,
) -> None:
    """Print recorded samples, combined samples, or the summary of each second.

    The default range is the last five minutes. A range includes its start and excludes its end.
    """
    # numpy takes longer to load than most commands to run.
    from iort_station import data  # noqa: PLC0415 - see above
    from iort_station.data import inventory  # noqa: PLC0415 - see above

    if form is Format.parquet and output is None and sys.stdout.isatty():
        raise StationError("a terminal cannot show Parquet: give --output FILE, or use a pipe")
    cloud, when = context.obj.cloud(), Range.of(start, end, last)
    began = time.monotonic()
    with reading(f"{robot} {stream}", when.start_us, when.end_us) as progress:
        result = data.query(
            cloud,
            robot,
            stream,
            when.start_us,
            when.end_us,
            fields=names(fields),
            where=where,
            every=every,
            summary=summary,
            on=on.value,
            scan=scan,
            progress=progress,
        )
    took_s = time.monotonic() - began
    _write(result, Format.jsonl if as_json else form, output, raw=raw)
    if result.refused:
        say(f"{result.refused} stored items are not batches and are left out; the first: {result.reason}")
    if result.absent:
        counted = ", ".join(f"{name} {count:,}" for name, count in sorted(result.absent.items()))
        say(f"null because the sensor is missing ({NO_SENSOR_DEGC:g} degC and below): {counted}")
    say(f"{len(result):,} {'seconds' if summary and not every else 'samples'} in {took_s:.2f} s")
    if not len(result) and (extent := inventory.extent(cloud, robot, stream)):
        say(f"none in this range; {robot} has {stream} from {extent[0]} to {extent[1]}")


def _write(result: Result, form: Format, output: Path | None, *, raw: bool) -> None:
    from iort_station.cli import tables  # noqa: PLC0415 - as above
    from iort_station.recordings import tabular  # noqa: PLC0415 - as above

    if form is Format.parquet:
        if output is None:
            tabular.to_parquet(result, sys.stdout.buffer)
        else:
            with output.open("wb") as file:
                tabular.to_parquet(result, file)
        return
    with output.open("w", encoding="utf-8", newline="") if output else nullcontext(sys.stdout) as text:
        if form is Format.csv:
            tabular.to_csv(result, text, raw=raw)
        elif form is Format.jsonl:
            tabular.to_json_lines(result, text)
        else:
            # In a file, every column fits.
            width = None if text.isatty() else 32 + 24 * len(result.columns)
            console = Console(file=text, width=width)
            shown = tables.terminal(result, console.width)
            console.print(shown.table)
            if shown.left_out:
                say(f"no room for {', '.join(shown.left_out)}: choose with --fields, or use --format csv")
