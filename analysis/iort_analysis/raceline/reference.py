"""A track as points at equal distances, with the direction across it and how far the car may go."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from iort_analysis.errors import AnalysisError
from iort_contract.track import Track

# The distance of points, as a share of the track's width, and the limits of their number.
_SPACING, _LEAST, _MOST = 0.2, 200, 1500
# Directions are those of the line smoothed over this many points, so that no noise turns them.
_SMOOTH = 3.0
# Lines across the track must not cross: how far they may go of the way to the centre of a curve.
_TO_CENTRE = 0.9


class TrackError(AnalysisError):
    """A track without a racing line; the text says why."""


@dataclass(frozen=True)
class Reference:
    """The centre line in points, an array of two columns in metres; the unit vectors to the left, and the
    bounds of the car's centre along them."""

    points: NDArray[np.float64]
    across: NDArray[np.float64]
    low: NDArray[np.float64]
    high: NDArray[np.float64]

    def line(self, offset: NDArray[np.float64]) -> NDArray[np.float64]:
        """The points of a line by its offsets to the left."""
        return self.points + offset[:, None] * self.across


def reference(track: Track, car_width_m: float) -> Reference:
    """The reference of a track, for a car that stays within its edges. Raises `TrackError`."""
    raw = np.column_stack([track.x_m, track.y_m])
    widths = np.column_stack([track.w_right_m, track.w_left_m])
    at = np.concatenate([[0.0], np.cumsum(_lengths(raw))])
    count = int(np.clip(at[-1] / (_SPACING * widths.sum(axis=1).mean()), _LEAST, _MOST))
    where = np.arange(count) * at[-1] / count
    points = np.column_stack([_hermite(where, at, column) for column in raw.T])
    # Widths are linear between points, as the edges are.
    right, left = (np.interp(where, at, np.append(column, column[0])) for column in widths.T)
    smooth = _smoothed(points)
    along = np.roll(smooth, -1, axis=0) - np.roll(smooth, 1, axis=0)
    along /= np.linalg.norm(along, axis=1)[:, None]
    across = np.column_stack([-along[:, 1], along[:, 0]])
    bend = curvature(smooth)[0]
    low, high = car_width_m / 2 - right, left - car_width_m / 2
    with np.errstate(divide="ignore"):
        centre = _TO_CENTRE / np.abs(bend)
    low = np.where(bend < 0, np.maximum(low, -centre), low)
    high = np.where(bend > 0, np.minimum(high, centre), high)
    if (low >= high).any():
        worst = int(np.argmin(high - low))
        raise TrackError(
            f"the track must be wider than the car ({car_width_m:g} m) between its edges and the centres of "
            f"its curves, got {right[worst] + left[worst]:.3g} m "
            f"at x {points[worst, 0]:.3g} m, y {points[worst, 1]:.3g} m"
        )
    return Reference(points, across, low, high)


def curvature(points: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The curvature of a closed line at each point, 1/m and positive to the left, and the length that the
    point stands for."""
    ahead, behind = np.roll(points, -1, axis=0), np.roll(points, 1, axis=0)
    first, second = (ahead - behind) / 2, ahead - 2 * points + behind
    length = np.linalg.norm(first, axis=1)
    return (first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]) / length**3, length


def _lengths(points: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(np.linalg.norm(np.roll(points, -1, axis=0) - points, axis=1))


def _hermite(
    where: NDArray[np.float64], at: NDArray[np.float64], values: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Values of a closed line between its points, by cubics with the slope of their neighbours."""
    n = values.size
    i = np.clip(np.searchsorted(at, where, side="right") - 1, 0, n - 1)
    steps = np.diff(at)
    rise = (np.roll(values, -1) - values) / steps
    before = np.roll(rise, 1)
    # The parabola through three points.
    slopes = (before * steps + rise * np.roll(steps, 1)) / (steps + np.roll(steps, 1))
    h, j = steps[i], (i + 1) % n
    t = (where - at[i]) / h
    return np.asarray(
        values[i] * (2 * t**3 - 3 * t**2 + 1)
        + values[j] * (3 * t**2 - 2 * t**3)
        + h * (slopes[i] * (t**3 - 2 * t**2 + t) + slopes[j] * (t**3 - t**2))
    )


def _smoothed(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """A closed line, smoothed by a bell of `_SMOOTH` points."""
    waves = np.fft.rfftfreq(points.shape[0])
    bell = np.exp(-2 * (np.pi * _SMOOTH * waves) ** 2)
    return np.fft.irfft(np.fft.rfft(points, axis=0) * bell[:, None], n=points.shape[0], axis=0)
