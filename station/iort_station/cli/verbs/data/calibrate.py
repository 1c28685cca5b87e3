"""`iort calibrate`: the parameters of a robot's car, from its analysed drives."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import typer
from rich.table import Table

from iort_contract.catalog.car import GROUPS
from iort_contract.messages.analysis import encode_estimate
from iort_station.cli.console import Lines, out, print_json
from iort_station.cli.options import AsJson, Robot, When, ranged
from iort_station.cli.words import examples, say
from iort_station.data import findings
from iort_station.errors import StationError
from iort_station.fleet import registry

if TYPE_CHECKING:
    from iort_station.data.findings import Calibration

commands = typer.Typer()


@commands.command("calibrate", epilog=examples("calibrate car7", "calibrate car7 --last 7d --json"))
@ranged
def calibrate(
    context: typer.Context,
    robot: Robot,
    when: When,
    count: Annotated[int, typer.Option(min=1, max=1000, help="The most drives to use; the newest.")] = 10,
    as_json: AsJson = False,
) -> None:
    """Print the parameters of a robot's car with 90 % intervals, and lines for its vesc.yaml.

    They come from the newest drives that were analysed: battery, motor, forces and heat. What a drive does
    not tell is listed with the reason.
    """
    within, cloud = when.range(), context.obj.cloud()
    drives = findings.drives(cloud, robot, within.start_us, within.end_us, most=count)
    if not drives:
        raise StationError(f"{robot} has no analysed drives in this range")
    found, vehicle = findings.calibration(drives), registry.vehicle_of(cloud, robot)
    lines = findings.vesc_yaml(found, vehicle)
    if as_json:
        told = {
            name: {**encode_estimate(one.estimate), "drives": one.drives} for name, one in found.found.items()
        }
        print_json(
            {"robot": robot, "parameters": told, "missing": dict(found.missing), "vesc_yaml": lines or None}
        )
        return
    _print(found)
    if not lines:
        return
    out.print(Lines(f"\nvesc.yaml:\n{lines}", end=""))
    gain = found.found[findings.GAIN].estimate
    if vehicle is not None and not gain.low <= vehicle.speed_to_erpm_gain <= gain.high:
        say(
            f"registered is {vehicle.speed_to_erpm_gain:.12g}; to correct speeds, also the recorded ones: "
            f"iort robots set {robot} {findings.GAIN}={gain.value:.1f}"
        )


def _print(found: Calibration) -> None:
    for heading, group in GROUPS.items():
        names = [one.name for one in group if one.name in found.found]
        if not names:
            continue
        shown = Table(title=heading, title_justify="left", box=None, pad_edge=False)
        for column in ("parameter", "value", "from", "to", "unit", "drives"):
            shown.add_column(
                column, justify="left" if column in {"parameter", "unit"} else "right", no_wrap=True
            )
        for name in names:
            estimate, drives = found.found[name]
            figures = (f"{value:.5g}" for value in (estimate.value, estimate.low, estimate.high))
            shown.add_row(name, *figures, "" if estimate.unit == "1" else estimate.unit, str(drives))
        out.print(shown)
    for name, reason in found.missing.items():
        out.print(f"no {name}: {reason}", highlight=False)
