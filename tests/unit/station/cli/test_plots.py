"""Plots: the content of each figure, and the error for data that cannot be drawn."""

from __future__ import annotations

import numpy as np
import pytest
from matplotlib.dates import date2num

from iort_station.cli import plots
from iort_station.cli.plots import Run
from iort_station.data import Result
from iort_station.errors import StationError

START = 1_700_000_000_000_000


def run(name="car", *, n=100, **columns):
    times = START + np.arange(n, dtype=np.int64) * 20_000
    return Run(name, Result(name, "vesc", times, columns or {"speed": np.arange(n, dtype=float)}))


def lines(panel):
    return [line for line in panel.get_lines() if len(line.get_xdata()) > 2]


def test_each_field_has_a_panel_with_its_unit_and_each_run_a_line():
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


def test_runs_can_be_drawn_from_their_start():
    figure = plots.over_time([run()], ["speed"], from_start=True)
    (line,) = lines(figure.axes[0])
    assert line.get_xdata()[:2].tolist() == [0.0, 0.02]
    assert figure.axes[0].get_xlabel() == "time since the start (s)"


def test_a_line_is_interrupted_at_a_hole():
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


def test_a_trajectory_is_drawn_to_scale_and_only_from_known_positions():
    turn = np.linspace(0, 6, 100)
    pose = {"position.x": np.cos(turn), "position.y": np.sin(turn)}
    figure = plots.trajectory([run("a", **pose), run("b", **pose)])
    (panel,) = figure.axes
    assert panel.get_aspect() == 1.0
    assert panel.get_xlabel() == "position.x (m)"
    assert len(lines(panel)) == 2
    with pytest.raises(StationError, match="has no position"):
        plots.trajectory([run()])


def test_a_distribution_is_drawn_in_per_cent_with_its_median():
    column = np.append(np.arange(99.0), np.nan)
    (panel,) = plots.distribution([run(speed=column)], ["speed"]).axes
    (median,) = [line for line in panel.get_lines() if len(line.get_xdata()) == 2]
    assert median.get_xdata()[0] == 49
    top = [patch.get_xy()[:, 1].max() for patch in panel.patches]
    assert max(top) <= 100
    assert panel.get_xlabel() == "speed\n(erpm)"


def test_a_field_or_format_that_cannot_be_drawn_is_named(tmp_path):
    with pytest.raises(StationError, match="volts cannot be drawn, only speed"):
        plots.over_time([run()], ["volts"])
    figure = plots.over_time([run()], ["speed"])
    with pytest.raises(StationError, match=r"must end in .pdf, .png, .svg"):
        plots.save(figure, tmp_path / "speed.gif")


@pytest.mark.parametrize(("name", "begins"), [("a.png", b"\x89PNG"), ("a.svg", b"<?xml"), ("a.pdf", b"%PDF")])
def test_plots_are_saved_in_every_format(tmp_path, name, begins):
    nothing = np.full(100, np.nan)
    figure = plots.over_time([run(speed=nothing), run("b", speed=np.arange(100.0))], ["speed"])
    plots.save(figure, tmp_path / name)
    assert (tmp_path / name).read_bytes().startswith(begins)


def degrees(latitude="latitude", longitude="longitude", **more):
    """A drive of 100 m north, then 100 m east; the receiver has no position at first."""
    metre = 180 / (np.pi * 6_371_008.8)
    north = np.append(np.arange(50) * 2, np.full(50, 100)) * metre
    east = np.append(np.zeros(50), np.arange(50) * 2) * metre / np.cos(np.radians(52))
    lat, lon = 52 + north, 13 + east
    lat[:3] = lon[:3] = 0
    return {latitude: lat, longitude: lon, **more}


@pytest.mark.parametrize(
    ("columns", "names"),
    [
        (degrees(), "latitude, longitude"),
        (degrees("gnss_lat", "gnss_lon", speed=np.ones(100)), "gnss_lat, gnss_lon"),
        (degrees("fix.latitude", "fix.longitude"), "fix.latitude, fix.longitude"),
    ],
)
def test_latitude_and_longitude_are_drawn_as_metres_from_the_first_known_position(columns, names):
    figure = plots.trajectory([run("a", **columns)])
    (panel,) = figure.axes
    (line,) = lines(panel)
    x, y = line.get_xdata(), line.get_ydata()
    assert np.isnan(x[:3]).all()
    assert (x[3], y[3]) == (0, 0)
    # The first known position was 6 m north.
    assert (x[-1], y[-1]) == (pytest.approx(98, rel=1e-4), pytest.approx(94, rel=1e-4))
    assert (panel.get_xlabel(), panel.get_ylabel()) == ("east (m)", "north (m)")
    assert f"{names} around 52.0000540, 13.0000000" in figure.get_suptitle()


def test_runs_share_their_origin():
    later = degrees()
    later["latitude"] += 0.001
    figure = plots.trajectory([run("a", **degrees()), run("b", **later)])
    one, other = lines(figure.axes[0])
    assert other.get_ydata()[-1] - one.get_ydata()[-1] == pytest.approx(111.2, abs=0.1)


def test_a_position_without_a_fix_is_left_out_and_the_antimeridian_makes_no_jump():
    status = np.zeros(100)
    status[-10:] = -1
    (line,) = lines(plots.trajectory([run(**degrees(), **{"status.status": status})]).axes[0])
    assert np.isnan(line.get_xdata()[-10:]).all()
    lon = (np.linspace(179.9999, 180.0001, 100) + 180) % 360 - 180
    (line,) = lines(plots.trajectory([run(latitude=np.full(100, 1e-6), longitude=lon)]).axes[0])
    assert line.get_xdata()[-1] == pytest.approx(22.2, abs=0.1)
    with pytest.raises(StationError, match="latitude, longitude hold no position: the receiver had no fix"):
        plots.trajectory([run(latitude=np.zeros(100), longitude=np.zeros(100))])
    with pytest.raises(StationError, match="a has x and y, b has latitude and longitude"):
        plots.trajectory([run("a", x=np.ones(100), y=np.ones(100)), run("b", **degrees())])
