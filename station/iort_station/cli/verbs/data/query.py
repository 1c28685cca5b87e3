"""`iort query`: what a robot has recorded."""

from __future__ import annotations

import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal, TextIO

import typer

from iort_contract.catalog.vesc import NO_SENSOR_DEGC
from iort_station.cli.console import Console
from iort_station.cli.options import (
    SHORT,
    Every,
    Fields,
    Force,
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
from iort_station.errors import UsageError
from iort_station.output import check_free, whole

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
    epilog=examples(
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
    summary: Annotated[
        bool, typer.Option("--summary", help="The summary of each second instead of samples.")
    ] = False,
    form: Annotated[
        Format | None,
        typer.Option("--format", help="The output format. Default: the ending of --out, or else a table."),
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="The same as --format jsonl.")] = False,
    raw: Annotated[
        bool, typer.Option("--raw", help="Leave formulas and control characters in the texts of CSV.")
    ] = False,
    out: Annotated[Path | None, to_file("The file to write. Default: standard output.")] = None,
    force: Force = False,
    on: Annotated[
        Literal["client", "lambda"],
        typer.Option(help="Select samples on this machine, or in the cloud's query function."),
    ] = "client",
    source: Annotated[
        Literal["auto", "table", "archive"],
        typer.Option(help="Read the table and, of what expires, the archive; or only one of them."),
    ] = "auto",
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

    form = "jsonl" if as_json else form or _form_of(out)
    if form == "parquet" and out is None and sys.stdout.isatty():
        raise UsageError("a terminal cannot show Parquet: give --out FILE, or use a pipe")
    if out is not None:
        check_free(out, force=force)
    within = when.range(SHORT)
    cloud = context.obj.cloud()
    began = time.monotonic()
    with reading(f"{robot} {stream}", within.start_us, within.end_us) as progress:
        result = data.query(
            cloud,
            robot,
            stream,
            within.start_us,
            within.end_us,
            fields=names(fields),
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
    say_refused(result.refused, result.reason)
    if result.absent:
        counted = ", ".join(f"{name} {count:,}" for name, count in sorted(result.absent.items()))
        say(f"null because the sensor is missing ({NO_SENSOR_DEGC:g} degC and below): {counted}")
    say(f"{len(result):,} {'seconds' if summary and not every else 'samples'} in {took_s:.2f} s")
    say_archived(result.origin.told())
    if not len(result) and (extent := inventory.extent(cloud, robot, stream)):
        say(f"none in this range; {robot} has {stream} from {extent[0]} to {extent[1]}")


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
    elif file.isatty():
        console = Console(file=file)
        shown = tables.terminal(result, console.width)
        console.print(shown.table)
        if shown.rows < len(result):
            say(f"{shown.rows} of {len(result):,} shown; a pipe or --out FILE.csv gets every one")
        if shown.left_out:
            say(f"no room for {', '.join(shown.left_out)}: choose with --fields, or use --out FILE.csv")
    else:
        tables.plain(result, file)
