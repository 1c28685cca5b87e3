"""Pictures of recorded samples: fields over time, trajectories, distributions.

The colours are Okabe and Ito's, which colour-blind people can tell apart; from the ninth series on the
dashes differ too.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from datetime import datetime, timezone
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.dates import AutoDateLocator, ConciseDateFormatter
from matplotlib.figure import Figure
from numpy.typing import NDArray

from iort_analysis.samples.positions import PositionFields, fixes, local_metres, position_fields
from iort_contract.triggers import Edge, Window
from iort_station.data import Result
from iort_station.errors import StationError, UsageError
from iort_station.output import whole

COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000", "#B8A800")
# By default: of a known stream these fields, of another the first few.
_KINDS = (".pdf", ".png", ".svg")
_USUAL = {"vesc": ("speed_mps", "current_motor", "voltage_input", "temperature_pcb")}
_PANELS = 4
_DASHES = ("-", "--", ":", "-.")
# More points than columns of pixels show nothing more, and make an SVG large.
_POINTS = 4_000
# A step of this many times the usual one, and of a second at least, is a gap in the line.
_GAP, _GAP_US = 5, 1_000_000


class Run(NamedTuple):
    """A result and its name in the legend."""

    name: str
    result: Result


def over_time(runs: Sequence[Run], fields: Sequence[str], *, from_start: bool = False) -> Figure:
    """Draw a panel for each field and a line for each run, by the clock (UTC) or from each run's start."""
    figure, panels = _panels(len(fields), height=1.9, shared=True)
    for panel, field in zip(panels, fields, strict=True):
        for i, run in enumerate(runs):
            times_us, values = _thinned(run.result.times_us, _column(run, field))
            origin_us = int(run.result.times_us[0]) if from_start else 0
            at: Any = (times_us - origin_us) / 1e6 if from_start else times_us.astype("datetime64[us]")
            panel.plot(at, values, label=run.name, linewidth=1.1, **_style(i))
        panel.set_ylabel(_labelled(runs, field))
        panel.margins(x=0.01)
    bottom = panels[-1]
    if from_start:
        bottom.set_xlabel("time since the start (s)")
    else:
        _by_clock(bottom)
    return _finished(figure, runs, "")


def moments(
    lines: Sequence[tuple[str, Result, str]], marks: Mapping[str, tuple[Sequence[Edge], Sequence[Window]]]
) -> Figure:
    """Draw a panel for each field of a robot over time, with lines where a trigger fired and bands for the
    windows that are kept. A robot without fields has a panel with lines and bands alone."""
    rows: list[tuple[str, Result | None, str]] = [*lines]
    rows += [(robot, None, "") for robot in marks if robot not in {row[0] for row in lines}]
    figure, panels = _panels(len(rows), height=1.9, shared=True)
    for panel, (robot, result, field) in zip(panels, rows, strict=True):
        edges, windows = marks[robot]
        for i, window in enumerate(windows):
            ends = np.array([window.from_us, window.to_us]).astype("datetime64[us]")
            panel.axvspan(*ends, color=COLOURS[4], alpha=0.25, linewidth=0, label="" if i else "kept")
        for i, edge in enumerate(edges):
            at = np.int64(edge.t_us).astype("datetime64[us]")
            panel.axvline(at, color=COLOURS[1], linewidth=0.9, label="" if i else "fired")
        if result is not None:
            run = Run(robot, result)
            times_us, values = _thinned(result.times_us, _column(run, field))
            panel.plot(times_us.astype("datetime64[us]"), values, linewidth=1.1, color=COLOURS[0])
            panel.set_ylabel(_labelled([run], field))
        else:
            panel.set_yticks([])
        if len(marks) > 1:
            panel.set_title(robot, fontsize=10, loc="left")
        panel.margins(x=0.01)
    _by_clock(panels[-1])
    handles, labels = next(
        (found for panel in panels if (found := panel.get_legend_handles_labels())[0]), ([], [])
    )
    figure.legend(handles, labels, loc="outside upper right", ncols=2, frameon=False)
    if len(marks) == 1:
        figure.suptitle(next(iter(marks)), fontsize=11)
    return figure


def _by_clock(panel: Any) -> None:
    locator = AutoDateLocator(tz=timezone.utc)
    panel.xaxis.set_major_locator(locator)
    panel.xaxis.set_major_formatter(ConciseDateFormatter(locator, tz=timezone.utc))
    panel.set_xlabel("time (UTC)")


def trajectory(runs: Sequence[Run]) -> Figure:
    """Draw the robots' ways from above, each from a ring to a dot.

    Latitudes and longitudes are drawn as metres to the east and north of the first known place. Raises
    `StationError` for a run without a position: it is not computed from speeds.
    """
    figure = _figure(7.0, 6.2)
    panel = figure.add_subplot()
    tracks, labels, note = _tracks(runs)
    for i, (run, (x, y)) in enumerate(zip(runs, tracks, strict=True)):
        style = _style(i)
        panel.plot(x, y, label=run.name, linewidth=1.4, **style)
        known = np.flatnonzero(~np.isnan(x) & ~np.isnan(y))
        if len(known):
            first, last = known[0], known[-1]
            panel.plot(x[first], y[first], "o", markerfacecolor="white", markersize=8, color=style["color"])
            panel.plot(x[last], y[last], "o", markersize=6, color=style["color"])
    panel.set_aspect("equal", adjustable="datalim")
    panel.set_xlabel(f"{labels[0]} (m)")
    panel.set_ylabel(f"{labels[1]} (m)")
    _dress(panel)
    return _finished(figure, runs, f"ring: start, dot: end{note}")


def _tracks(runs: Sequence[Run]) -> tuple[list[tuple[Any, Any]], tuple[str, str], str]:
    """Each run's x and y in metres, the names of the axes, and a note for the title."""
    fields = [position_of(run.result) for run in runs]
    if len({each.degrees for each in fields}) > 1:
        raise StationError(
            "positions in metres and in degrees cannot be drawn together: "
            + ", ".join(
                f"{run.name} has {' and '.join(of.names)}" for run, of in zip(runs, fields, strict=True)
            )
        )
    of = list(zip(runs, fields, strict=True))
    if not fields[0].degrees:
        metres = [(_column(run, x), _column(run, y)) for run, ((x, y), _) in of]
        return metres, fields[0].names, ""
    places = [fixes(run.result.columns, each) for run, each in of]
    first = next(((la[i], lo[i]) for la, lo in places for i in np.flatnonzero(~np.isnan(la))[:1]), None)
    if first is None:
        raise StationError(f"{', '.join(fields[0].names)} hold no position: the receiver had no fix")
    note = f"\n{', '.join(fields[0].names)} around {first[0]:.7f}, {first[1]:.7f}"
    return [local_metres(*place, first) for place in places], ("east", "north"), note


def distribution(runs: Sequence[Run], fields: Sequence[str]) -> Figure:
    """Draw a histogram for each field; the vertical line is the median."""
    figure, panels = _panels(len(fields), height=2.4, shared=False)
    for panel, field in zip(panels, fields, strict=True):
        columns = [column[~np.isnan(column)] for column in (_column(run, field) for run in runs)]
        everything = np.concatenate(columns)
        count = int(min(80, max(10, np.sqrt(len(everything)))))
        bins = np.histogram_bin_edges(everything, bins=count) if len(everything) else 1
        for i, (run, column) in enumerate(zip(runs, columns, strict=True)):
            if not len(column):
                continue
            style = _style(i)
            weights = np.full(len(column), 100 / len(column))
            panel.hist(column, bins, weights=weights, histtype="stepfilled", alpha=0.25, color=style["color"])
            panel.hist(column, bins, weights=weights, histtype="step", label=run.name, **style)
            panel.axvline(float(np.median(column)), linewidth=1.2, **style)
        panel.set_xlabel(_labelled(runs, field))
        panel.set_ylabel("samples (%)")
    return _finished(figure, runs, "line: median")


def delta_time(found: Mapping[str, Any], one: int, other: int) -> Figure:
    """Draw how far a lap is behind another one at each place, and both speeds."""
    figure, (delta, speed) = _panels(2, height=2.2, shared=True)
    delta.axhline(0, color="#808080", linewidth=0.8)
    delta.plot(found["place_m"], found["delta_s"], **_style(0))
    delta.set_ylabel(f"lap {other} behind\nlap {one} (s)")
    for i, (name, lap) in enumerate((("one_mps", one), ("other_mps", other))):
        speed.plot(found["place_m"], found[name], label=f"lap {lap}", linewidth=1.1, **_style(i + 1))
    speed.set_ylabel("speed (m/s)")
    speed.set_xlabel("distance (m)")
    speed.legend(frameon=False, ncols=2)
    return figure


def check_ending(path: Path) -> None:
    """Raise `UsageError` if the file's ending names no kind of picture."""
    if path.suffix.lower() not in _KINDS:
        raise UsageError(f"the file must end in {', '.join(_KINDS)}, got {path}")


def save(figure: Figure, path: Path, *, force: bool = False) -> None:
    """Write a picture as png, svg or pdf, by the file's ending. Raises `StationError` if the file exists."""
    check_ending(path)
    with whole(path, force=force) as part:
        figure.savefig(part, format=path.suffix.lower()[1:], dpi=160, facecolor="white")


def position_of(result: Result) -> PositionFields:
    """The fields of a robot's position; raises `StationError` if there are none."""
    fields = position_fields([name for name, column in result.columns.items() if column.dtype.kind == "f"])
    if fields is None:
        raise StationError(
            f"{result.robot} {result.stream} has no position, such as x and y, or latitude and longitude; "
            f"it has {', '.join(result.columns)}"
        )
    return fields


def numeric(result: Result) -> list[str]:
    """The fields that can be drawn."""
    return [name for name, column in result.columns.items() if column.dtype.kind in "fb"]


def usual(result: Result) -> list[str]:
    """The fields to draw by default."""
    known = numeric(result)
    return [name for name in _USUAL.get(result.stream, ()) if name in known] or known[:_PANELS]


def when(t_us: int) -> str:
    """A run's start for the legend."""
    at = datetime.fromtimestamp(t_us // 1_000_000, tz=timezone.utc)
    return at.strftime("%Y-%m-%d %H:%M:%S")


def _column(run: Run, field: str) -> NDArray[np.float64]:
    column = run.result.columns.get(field)
    if column is None or column.dtype.kind not in "fb":
        raise StationError(f"{run.name}: {field} cannot be drawn, only {', '.join(numeric(run.result))}")
    return column.astype(np.float64)


def _thinned(times_us: Any, values: Any) -> tuple[Any, Any]:
    """At most `_POINTS` points: the lowest and the highest of each stretch, and NaN in each gap."""
    if len(values) > _POINTS:
        edges = np.linspace(0, len(values), _POINTS // 2 + 1).astype(int)[:-1]
        lows, highs = np.fmin.reduceat(values, edges), np.fmax.reduceat(values, edges)
        values = np.column_stack([lows, highs]).ravel()
        times_us = np.repeat(times_us[edges], 2)
    steps = np.diff(times_us)
    if not len(steps):
        return times_us, values
    usual = np.median(steps[steps > 0]) if (steps > 0).any() else 0
    gaps = np.flatnonzero(steps > max(_GAP_US, _GAP * usual)) + 1
    return np.insert(times_us, gaps, times_us[gaps - 1] + 1), np.insert(values, gaps, np.nan)


def _style(i: int) -> dict[str, Any]:
    return {"color": COLOURS[i % len(COLOURS)], "linestyle": _DASHES[i // len(COLOURS) % len(_DASHES)]}


def _labelled(runs: Sequence[Run], field: str) -> str:
    unit = " or ".join(dict.fromkeys(run.result.unit(field) for run in runs))
    return f"{field}\n({unit})" if unit and unit != "1" else field


def _figure(width: float, height: float) -> Figure:
    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def _panels(n: int, *, height: float, shared: bool) -> tuple[Figure, list[Any]]:
    figure = _figure(10.0, 0.9 + height * n)
    panels = [row[0] for row in figure.subplots(n, 1, sharex=shared, squeeze=False)]
    for panel in panels:
        _dress(panel)
    return figure, panels


def _dress(panel: Any) -> None:
    panel.grid(visible=True, color="#d0d0d0", linewidth=0.6)
    panel.set_axisbelow(True)
    for side in ("top", "right"):
        panel.spines[side].set_visible(False)


def _finished(figure: Figure, runs: Sequence[Run], note: str) -> Figure:
    handles, labels = figure.axes[0].get_legend_handles_labels()
    if len(runs) > 1:
        figure.legend(handles, labels, loc="outside upper left", ncols=min(4, len(runs)), frameon=False)
        title = note
    else:
        title = ", ".join(part for part in (runs[0].name, note) if part)
    if title:
        figure.suptitle(title, fontsize=11)
    return figure
