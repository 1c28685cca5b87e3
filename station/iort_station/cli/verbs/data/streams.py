"""`iort streams`: what is stored of a robot."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import typer
from rich.padding import Padding
from rich.table import Table

from iort_station.cli.console import errors, out, print_json
from iort_station.cli.options import AsJson, Robot
from iort_station.cli.words import examples, say_archived
from iort_station.times import between, between_hours, iso_s

if TYPE_CHECKING:
    from iort_station.data.runs import StreamOverview

commands = typer.Typer()


@commands.command("streams", epilog=examples("streams car7"))
def streams(context: typer.Context, robot: Robot, as_json: AsJson = False) -> None:
    """List a robot's streams: their fields with units, their runs, their first and last sample.

    The command reads some batches of each run, never all samples. The fields are those of the newest batch.
    """
    # numpy takes longer to load than TAB may take.
    from iort_analysis.archive.stored import Origin  # noqa: PLC0415 - as above
    from iort_station.data.runs import overview  # noqa: PLC0415 - see above

    cloud, origin = context.obj.cloud(), Origin()
    with errors.status("reading"):
        found = overview(cloud, robot, origin=origin)
    archived = origin.told()
    if as_json:
        listed = [_as_json(one) for one in found]
        print_json({"robot": robot, "streams": listed, "archive": archived and between_hours(archived)})
        return
    if not found:
        errors.print(f"{robot} has sent nothing yet")
    for one in found:
        table = Table(box=None, pad_edge=False, show_header=False)
        for name, unit in one.fields.items():
            table.add_row(name, unit)
        counted = f"{one.runs}{'+' if one.older else ''} {'run' if one.runs == 1 else 'runs'}"
        extent = f"{iso_s(one.extent['from_us'])} to {iso_s(one.extent['to_us'])}"
        out.print(f"{one.stream}: {counted}, {extent}", style="bold", soft_wrap=True)
        out.print(Padding(table, (0, 0, 1, 2)))
    say_archived(archived)


def _as_json(one: StreamOverview) -> dict[str, Any]:
    fields = [{"name": name, "unit": unit or None} for name, unit in one.fields.items()]
    counted = {"runs": one.runs, "more_runs": one.older}
    return {"stream": one.stream, **between(one.extent), **counted, "fields": fields}
