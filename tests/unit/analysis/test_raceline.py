"""The racing line: against known optima, the conditions of an optimum, and TU Munich's published lines."""

from __future__ import annotations

import math
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from iort_analysis.raceline import (
    Limits,
    Reference,
    TrackError,
    curvature,
    least_curvature,
    profile,
    reference,
)
from iort_analysis.statistics import quadratic
from iort_contract.track import Track, parse_track

CAR_M = 0.3
LIMITS = Limits(mass_kg=3.5, grip=0.8, power_w=300, accel_mps2=6, brake_mps2=6, speed_mps=12)
GRIP = LIMITS.grip * 9.81
HALL = parse_track((Path(__file__).parents[3] / "docs/examples/hall.csv").read_text())


def track(x_m: NDArray[np.float64], y_m: NDArray[np.float64], half_m: float = 1.0) -> Track:
    width = (half_m,) * x_m.size
    return Track(tuple(x_m.tolist()), tuple(y_m.tolist()), width, width)


def ring(radius_m: float, half_m: float = 1.0) -> Track:
    """A circle, anticlockwise."""
    angle = np.linspace(0, 2 * np.pi, 400, endpoint=False)
    return track(radius_m * np.cos(angle), radius_m * np.sin(angle), half_m)


def bent(points: NDArray[np.float64]) -> float:
    """The integral of the squared curvature."""
    bend, length = curvature(points)
    return float(bend**2 @ length)


def on(track_: Track, car_m: float = CAR_M) -> tuple[Reference, NDArray[np.float64]]:
    found = reference(track_, car_m)
    return found, least_curvature(found)


def test_around_a_circle_the_least_curvature_is_at_the_outer_edge() -> None:
    found, offset = on(ring(10.0))
    # The left is inside; the car's side touches the edge.
    assert offset == pytest.approx(np.full(offset.size, -(1.0 - CAR_M / 2)), abs=2e-3)
    assert bent(found.line(offset)) == pytest.approx(2 * math.pi / (10.0 + 1.0 - CAR_M / 2), rel=1e-3)


def slopes(found: Reference, offset: NDArray[np.float64]) -> NDArray[np.float64]:
    """The cost's derivatives by every seventh offset, from the cost alone."""
    step, sloped = 1e-4, []
    for i in range(0, offset.size, 7):
        one = step * (np.arange(offset.size) == i)
        ahead, behind = bent(found.line(offset + one)), bent(found.line(offset - one))
        sloped.append((ahead - behind) / (2 * step))
    return np.array(sloped)


@pytest.mark.parametrize("made", [HALL, ring(6.0)], ids=["hall", "ring"])
def test_the_line_stays_within_the_track_and_no_small_change_is_better(made: Track) -> None:
    found, offset = on(made)
    assert (offset >= found.low - 1e-9).all()
    assert (offset <= found.high + 1e-9).all()
    slope, usual = slopes(found, offset), np.abs(slopes(found, np.zeros_like(offset))).max()
    low, high = ((offset < found.low + 1e-3)[::7], (offset > found.high - 1e-3)[::7])
    assert np.abs(slope[~low & ~high]).max(initial=0.0) < 0.02 * usual
    assert (slope[low] > -0.02 * usual).all()
    assert (slope[high] < 0.02 * usual).all()


def test_the_halls_line_is_faster_than_its_centre() -> None:
    found, offset = on(HALL)
    line, centre = found.line(offset), found.points
    assert bent(line) < 0.4 * bent(centre)
    assert profile(line, LIMITS).lap_s < 0.75 * profile(centre, LIMITS).lap_s


def test_the_direction_of_driving_and_the_start_change_nothing() -> None:
    columns = (HALL.x_m, HALL.y_m, HALL.w_right_m, HALL.w_left_m)
    turned = Track(*(column[50:] + column[:50] for column in columns))
    x_m, y_m, right, left = (column[::-1] for column in columns)
    costs = [
        bent(found.line(offset)) for found, offset in map(on, (HALL, turned, Track(x_m, y_m, left, right)))
    ]
    assert costs == pytest.approx([costs[0]] * 3, rel=0.01)


def test_a_track_narrower_than_the_car_has_no_line() -> None:
    with pytest.raises(TrackError, match=r"wider than the car \(2.5 m\).* got 2 m at x"):
        reference(ring(10.0), 2.5)


def test_a_hairpin_tighter_than_the_track_is_wide_has_a_line() -> None:
    """Lines across the track would meet inside of it."""
    points = stadium(8.0, 0.7)[::4]
    found, offset = on(track(points[:, 0], points[:, 1]))
    line = found.line(offset)
    ahead = np.roll(line, -1, axis=0) - line
    along = np.column_stack([found.across[:, 1], -found.across[:, 0]])
    assert ((ahead * along).sum(axis=1) > 0).all(), "no point overtakes the next"
    assert bent(line) < bent(found.points)


# --- the speeds -------------------------------------------------------------------------------------


def test_around_a_circle_the_grip_gives_the_speed() -> None:
    points = reference(ring(5.0), CAR_M).points
    found = profile(points, LIMITS)
    assert found.speed_mps == pytest.approx(np.full(found.speed_mps.size, math.sqrt(GRIP * 5)), rel=1e-3)
    assert found.lap_s == pytest.approx(2 * math.pi * 5 / math.sqrt(GRIP * 5), rel=1e-3)


def stadium(straight_m: float, radius_m: float) -> NDArray[np.float64]:
    """Two straights and two half circles, from the start of the first straight on."""
    along = np.arange(0, straight_m, 0.05)
    angle = np.arange(0, np.pi, 0.05 / radius_m)
    ahead = np.column_stack([along, np.zeros(along.size)])
    turn = np.column_stack([straight_m + radius_m * np.sin(angle), radius_m * (1 - np.cos(angle))])
    back = np.array([straight_m, 2 * radius_m]) - np.vstack([ahead, turn])
    return np.vstack([ahead, turn, back])


def test_a_straight_is_limited_by_power_then_by_the_brakes() -> None:
    limits = replace(LIMITS, power_w=40, accel_mps2=100, brake_mps2=4, speed_mps=100)
    found = profile(stadium(20.0, 2.0), limits)
    slow = math.sqrt(GRIP * 2)
    # At constant power v^3 grows with the way; the brakes end it at the curve's speed.
    for at_m in (4.0, 8.0):
        i = int(np.searchsorted(found.at_m, at_m))
        expected = (slow**3 + 3 * limits.power_w / limits.mass_kg * at_m) ** (1 / 3)
        assert found.speed_mps[i] == pytest.approx(expected, rel=0.03)
    i = int(np.searchsorted(found.at_m, 19.0))
    assert found.speed_mps[i] == pytest.approx(math.sqrt(slow**2 + 2 * 4 * 1.0), rel=0.03)


def test_no_limit_of_the_car_is_exceeded() -> None:
    limits = replace(LIMITS, rolling_n=1.0, drag_n_s2_per_m2=0.05, speed_mps=6)
    found, offset = on(HALL)
    at = profile(found.line(offset), limits)
    ahead = np.roll(at.speed_mps, -1)
    way = np.diff(np.append(at.at_m, at.length_m))
    accel = (ahead**2 - at.speed_mps**2) / (2 * way)
    assert at.speed_mps.max() <= 6
    assert (at.speed_mps**2 * np.abs(at.curvature_1pm)).max() <= GRIP * (1 + 1e-9)
    assert accel.max() <= limits.accel_mps2
    resisted = (limits.rolling_n + limits.drag_n_s2_per_m2 * ahead**2) / limits.mass_kg
    assert (-accel - resisted).max() <= limits.brake_mps2 * (1 + 1e-9)
    assert at.lap_s > profile(found.line(offset), LIMITS).lap_s


# --- the solvers ------------------------------------------------------------------------------------

seeds = st.integers(0, 10_000)


def system(seed: int, n: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """A cyclic band of five diagonals that is positive definite, as diagonals and in full."""
    chance = np.random.default_rng(seed)
    rows = np.zeros((n, n))
    for i in range(n):
        rows[i, [(i - 1) % n, i, (i + 1) % n]] = chance.normal(size=3)
    full = rows.T @ rows + 0.1 * np.eye(n)
    return np.array([[full[i, (i + k) % n] for i in range(n)] for k in range(3)]), full


@settings(max_examples=20, deadline=None)
@given(seeds, st.integers(9, 150))
def test_the_banded_solver_agrees_with_numpys(seed: int, n: int) -> None:
    diagonals, full = system(seed, n)
    right = np.random.default_rng(seed).normal(size=n)
    assert quadratic.product(diagonals, right) == pytest.approx(full @ right)
    assert quadratic.solve(diagonals, right) == pytest.approx(
        np.linalg.solve(full, right), rel=1e-6, abs=1e-8
    )


@settings(max_examples=20, deadline=None)
@given(seeds, st.integers(12, 80))
def test_the_quadratic_programme_meets_the_conditions_of_an_optimum(seed: int, n: int) -> None:
    chance = np.random.default_rng(seed)
    diagonals, full = system(seed, n)
    gradient = chance.normal(size=n)
    low = -chance.uniform(0.01, 1, size=n)
    high = low + chance.uniform(0.02, 2, size=n)
    x = quadratic.minimum(diagonals, gradient, low, high)
    assert ((x >= low) & (x <= high)).all()
    slope = full @ x + gradient
    # A convex programme has no other optimum: a slope only against a bound that is reached.
    assert (np.maximum(slope, 0) * (x - low)).max() < 1e-5
    assert (np.maximum(-slope, 0) * (high - x)).max() < 1e-5


# --- a published implementation's lines -------------------------------------------------------------

# TU Munich's racetrack-database (LGPL) is not copied: IORT_RACETRACKS names a clone of
# https://github.com/TUMFTM/racetrack-database. Its lines were made by global_racetrajectory_optimization.
RACETRACKS = os.environ.get("IORT_RACETRACKS")
# Its lines keep 0.75 m from the edges, so this is the width of its car. The limits are those of a race car.
THEIR_CAR_M = 1.5
RACE_CAR = Limits(1200, 1.56, 300e3, 10, 15, 80, 0, 0.9)

if RACETRACKS is not None:

    @pytest.mark.parametrize("name", ["Spielberg", "Silverstone", "Hockenheim", "Sakhir", "Zandvoort"])
    def test_curvature_and_lap_time_are_those_of_the_published_line(name: str) -> None:
        folder = Path(str(RACETRACKS))
        found, offset = on(parse_track((folder / f"tracks/{name}.csv").read_text()), THEIR_CAR_M)
        ours = found.line(offset)
        raw = np.loadtxt(folder / f"racelines/{name}.csv", delimiter=",")
        # At as many points, since a coarse line hides curvature.
        theirs = reference(track(raw[:-1, 0], raw[:-1, 1]), 0.1).points
        assert bent(ours) == pytest.approx(bent(theirs), rel=0.025)
        laps = [profile(line, RACE_CAR).lap_s for line in (ours, theirs)]
        assert laps[0] == pytest.approx(laps[1], rel=0.015)
