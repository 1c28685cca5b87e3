"""`iort laps` and `calibrate`: a robot's laps, two of them side by side, and its car's parameters."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from iort_contract.catalog.analysis import LAPS_TABLE, PARAMETERS, PLACES_TABLE
from iort_contract.catalog.car import GROUPS
from iort_contract.messages.analysis import encode_estimate
from iort_station.cli import console
from iort_station.cli.console import Lines, out, print_json, reading
from iort_station.cli.options import AsJson, Force, Robot, When, examples, option, ranged, say
from iort_station.errors import StationError, UsageError
from iort_station.fleet import registry
from iort_station.output import check_free
from iort_station.times import iso, iso_s

if TYPE_CHECKING:
    from iort_analysis.results import Table as Columns
    from iort_station.data.runs import RunLaps

commands = typer.Typer()
# The rows of a comparison in a terminal; JSON and the picture have every place.
_ROWS = 20
_METHODS = {
    "gate": "by crossing a gate of the position",
    "pattern": "by the pattern of the drive, because no stream has a position",
}
_COLUMNS = (
    ("time_s", "time s", 3),
    ("distance_m", "m", 1),
    ("energy_wh", "Wh", 3),
    ("energy_wh_per_km", "Wh/km", 2),
    ("mean_speed_mps", "m/s", 2),
    ("top_speed_mps", "top m/s", 2),
)


@commands.command(
    "laps",
    epilog=examples("laps car7", "laps car7 --last 1d --json", "laps car7 --compare 3 7 --out laps.png"),
)
@ranged
def laps(
    context: typer.Context,
    robot: Robot,
    when: When,
    compare: Annotated[tuple[int, int] | None, option("The delta-time of two laps of a run: 3 7.")] = None,
    count: Annotated[int, option("The most runs to search; the newest.", min=1, max=1000)] = 20,
    file: Annotated[Path | None, option("Draw the comparison: .png, .svg or .pdf.", "--out", "-o")] = None,
    force: Force = False,
    as_json: AsJson = False,
) -> None:
    """List the laps of a robot's runs: time, distance and energy, with the best lap marked.

    Laps are found where the car crosses a gate, or without a position by the pattern of the drive; the line
    below a table says which. Without a range, the newest run is searched. Intervals are of 90 %.
    """
    # numpy takes longer to load than most commands to run.
    from iort_station.data.runs import laps_of_runs  # noqa: PLC0415 - see above

    if file is not None:
        if compare is None:
            raise UsageError("--out draws a comparison: give --compare too, for example --compare 3 7")
        _plots().check_ending(file)
        check_free(file, force=force)
    newest_alone = when == When() or compare is not None
    within = when.range()
    with reading(robot, within.start_us, within.end_us) as progress:
        found = list(
            laps_of_runs(
                context.obj.cloud(),
                robot,
                within.start_us,
                within.end_us,
                count=1 if newest_alone else count,
                progress=progress,
            )
        )
    if not found:
        raise StationError(f"{robot} has no runs in this range")
    if compare is None:
        if as_json:
            print_json({"robot": robot, "runs": [_as_json(one) for one in found]})
        else:
            for one in found:
                _print(one)
        return
    _compare(found[-1], *compare, file=file, force=force, as_json=as_json)


def _print(run: RunLaps) -> None:
    out.print(f"run {run.run[:8]}, {iso_s(run.start_us)} to {iso_s(run.end_us)}")
    table = run.mined.tables.get(LAPS_TABLE)
    if table is None:
        out.print(next(iter(run.mined.missing.values())))
        return
    figures_of = (heading for _, heading, _ in _COLUMNS)
    shown = console.table("lap", "start (UTC)", *figures_of, "", left=("start (UTC)", ""))
    for i, lap in enumerate(table["lap"].tolist()):
        mark = "best" if table["best"][i] else "" if table["complete"][i] else "not complete"
        figures = [_figure(float(table[name][i]), digits) for name, _, digits in _COLUMNS]
        # The line above has the day.
        start = iso(int(table["start_us"][i])).partition("T")[2][:-4]
        shown.add_row(str(lap), start, *figures, mark, style="bold" if mark == "best" else "")
    out.print(shown)
    for name, estimate in run.mined.estimates.items():
        low, high = (f"{value:.5g}" for value in (estimate.low, estimate.high))
        out.print(f"{PARAMETERS[name].meaning}: {estimate.value:.5g} {estimate.unit} ({low} to {high})")
    out.print(f"{_METHODS[table['method'][0]]}; {float(table['confidence'][0]):.0%} sure")


def _as_json(run: RunLaps) -> dict[str, Any]:
    table = run.mined.tables.get(LAPS_TABLE, {})
    return {
        "run": run.run,
        "from": iso(run.start_us),
        "to": iso(run.end_us),
        "laps": _rows(table),
        "estimates": {name: encode_estimate(found) for name, found in run.mined.estimates.items()},
        "missing": dict(run.mined.missing),
    }


def _compare(run: RunLaps, one: int, other: int, *, file: Path | None, force: bool, as_json: bool) -> None:
    from iort_analysis import AnalysisError  # noqa: PLC0415 - as above
    from iort_analysis.mining.laps import compare  # noqa: PLC0415 - as above

    places = run.mined.tables.get(PLACES_TABLE)
    if places is None:
        raise StationError(next(iter(run.mined.missing.values())))
    try:
        found = compare(places, one, other)
    except AnalysisError as error:
        raise UsageError(f"--compare: {error}") from error
    if file is not None:
        plots = _plots()
        plots.save(plots.delta_time(found, one, other), file, force=force)
        say(f"{file} shows the comparison")
    if as_json:
        print_json({"run": run.run, "one": one, "other": other, "places": _rows(found)})
        return
    shown = console.table("place m", "delta s", f"lap {one} m/s", f"lap {other} m/s")
    last = len(found["delta_s"]) - 1
    for i in (round(last * k / _ROWS) for k in range(_ROWS + 1)):
        row = [float(found[name][i]) for name in ("place_m", "delta_s", "one_mps", "other_mps")]
        shown.add_row(_figure(row[0], 1), f"{row[1]:+.3f}", _figure(row[2], 2), _figure(row[3], 2))
    out.print(shown)
    behind = float(found["delta_s"][-1])
    out.print(f"lap {other} takes {abs(behind):.3f} s {'more' if behind > 0 else 'less'} than lap {one}")


def _rows(table: Columns) -> list[dict[str, Any]]:
    """A table's rows for JSON: null for a number that is not known."""
    columns = {name: column.tolist() for name, column in table.items()}
    rows = [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)]
    return [{name: _known(value) for name, value in row.items()} for row in rows]


def _known(value: Any) -> Any:
    return None if isinstance(value, float) and math.isnan(value) else value


def _figure(value: float, digits: int) -> str:
    return "-" if math.isnan(value) else f"{value:.{digits}f}"


def _plots() -> Any:
    from iort_station.cli import plots  # noqa: PLC0415 - as above

    return plots


# `iort calibrate`: the parameters of a robot's car, from its analysed drives.

if TYPE_CHECKING:
    from iort_station.data.findings import Calibration


@commands.command("calibrate", epilog=examples("calibrate car7", "calibrate car7 --last 7d --json"))
@ranged
def calibrate(
    context: typer.Context,
    robot: Robot,
    when: When,
    count: Annotated[int, option("The most drives to use; the newest.", min=1, max=1000)] = 10,
    as_json: AsJson = False,
) -> None:
    """Print the parameters of a robot's car with 90 % intervals, and lines for its vesc.yaml.

    They come from the newest drives that were analysed: battery, motor, forces and heat. What a drive does
    not tell is listed with the reason.
    """
    # numpy takes longer to load than TAB may take.
    from iort_station.data import findings  # noqa: PLC0415 - see above

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
    _print_calibrate(found)
    if not lines:
        return
    out.print(Lines(f"\nvesc.yaml:\n{lines}", end=""))
    gain = found.found[findings.GAIN].estimate
    if vehicle is not None and not gain.low <= vehicle.speed_to_erpm_gain <= gain.high:
        say(
            f"registered is {vehicle.speed_to_erpm_gain:.12g}; to correct speeds, also the recorded ones: "
            f"iort robots set {robot} {findings.GAIN}={gain.value:.1f}"
        )


def _print_calibrate(found: Calibration) -> None:
    for heading, group in GROUPS.items():
        names = [one.name for one in group if one.name in found.found]
        if not names:
            continue
        head = ("parameter", "value", "from", "to", "unit", "drives")
        shown = console.table(*head, left=("parameter", "unit"), title=heading)
        for name in names:
            estimate, drives = found.found[name]
            figures = (f"{value:.5g}" for value in (estimate.value, estimate.low, estimate.high))
            shown.add_row(name, *figures, "" if estimate.unit == "1" else estimate.unit, str(drives))
        out.print(shown)
    for name, reason in found.missing.items():
        out.print(f"no {name}: {reason}", highlight=False)
