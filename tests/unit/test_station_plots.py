"""Pictures: what is on them, read from the figure, and what cannot be drawn."""

from __future__ import annotations

import numpy as np
import pytest
from matplotlib.dates import date2num

from station import plots
from station.data import Result
from station.errors import StationError
from station.plots import Run

START = 1_700_000_000_000_000


def run(name="car", *, n=100, **columns):
    times = START + np.arange(n, dtype=np.int64) * 20_000
    return Run(name, Result(name, "vesc", times, columns or {"speed": np.arange(n, dtype=float)}))


def lines(panel):
    return [line for line in panel.get_lines() if len(line.get_xdata()) > 2]


def test_a_panel_a_field_and_a_line_a_run_with_units():
    columns = {"speed": np.arange(100.0), "current_motor": np.ones(100)}
    figure = plots.over_time([run("a", **columns), run("b", **columns)], ["speed", "current_motor"])
    assert [panel.get_ylabel() for panel in figure.axes] == ["speed\n(erpm)", "current_motor\n(A)"]
    assert [len(lines(panel)) for panel in figure.axes] == [2, 2]
    assert figure.axes[-1].get_xlabel() == "time (UTC)"
    assert date2num(lines(figure.axes[0])[0].get_xdata()[0]) == pytest.approx(START / 86_400e6)
    colours = {line.get_color() for line in lines(figure.axes[0])}
    assert len(colours) == 2
    (legend,) = figure.legends
    assert [text.get_text() for text in legend.get_texts()] == ["a", "b"]


def test_runs_from_their_start():
    figure = plots.over_time([run()], ["speed"], from_start=True)
    (line,) = lines(figure.axes[0])
    assert line.get_xdata()[:2].tolist() == [0.0, 0.02]
    assert figure.axes[0].get_xlabel() == "time since the start (s)"


def test_no_line_bridges_a_hole():
    one = run()
    times = one.result.times_us.copy()
    times[50:] += 10_000_000
    holed = Run("car", Result("car", "vesc", times, one.result.columns))
    (line,) = lines(plots.over_time([holed], ["speed"], from_start=True).axes[0])
    assert np.isnan(line.get_ydata()).sum() == 1
    assert len(line.get_xdata()) == 101


def test_a_long_run_keeps_its_extremes():
    speed = np.zeros(100_000)
    speed[12_345], speed[54_321] = 9.0, -9.0
    (line,) = lines(plots.over_time([run(n=100_000, speed=speed)], ["speed"]).axes[0])
    assert len(line.get_ydata()) < 5_000
    assert (line.get_ydata().max(), line.get_ydata().min()) == (9, -9)


def test_a_trajectory_is_drawn_to_scale_and_never_made_up():
    turn = np.linspace(0, 6, 100)
    pose = {"position.x": np.cos(turn), "position.y": np.sin(turn)}
    figure = plots.trajectory([run("a", **pose), run("b", **pose)])
    (panel,) = figure.axes
    assert panel.get_aspect() == 1.0
    assert panel.get_xlabel() == "position.x (m)"
    assert len(lines(panel)) == 2
    with pytest.raises(StationError, match="has no position"):
        plots.trajectory([run()])


def test_a_distribution_is_in_per_cent_with_its_median():
    column = np.append(np.arange(99.0), np.nan)
    (panel,) = plots.distribution([run(speed=column)], ["speed"]).axes
    (median,) = [line for line in panel.get_lines() if len(line.get_xdata()) == 2]
    assert median.get_xdata()[0] == 49
    top = [patch.get_xy()[:, 1].max() for patch in panel.patches]
    assert max(top) <= 100
    assert panel.get_xlabel() == "speed\n(erpm)"


def test_what_cannot_be_drawn_is_named(tmp_path):
    with pytest.raises(StationError, match="volts cannot be drawn; what can is speed"):
        plots.over_time([run()], ["volts"])
    figure = plots.over_time([run()], ["speed"])
    with pytest.raises(StationError, match=r"allowed is a file ending in .pdf, .png, .svg"):
        plots.save(figure, tmp_path / "speed.gif")


@pytest.mark.parametrize(("name", "begins"), [("a.png", b"\x89PNG"), ("a.svg", b"<?xml"), ("a.pdf", b"%PDF")])
def test_pictures_are_written(tmp_path, name, begins):
    nothing = np.full(100, np.nan)
    figure = plots.over_time([run(speed=nothing), run("b", speed=np.arange(100.0))], ["speed"])
    plots.save(figure, tmp_path / name)
    assert (tmp_path / name).read_bytes().startswith(begins)
