"""Signals on even steps of time: means, lags and smooth curves, as columns of a model."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
# The median of normal errors' absolute values, times this, is their standard deviation.
MAD_TO_SIGMA = 1.4826

_FADES = 8
# Decimal places that a sensor's values may have, and how many values show at once that they have more.
_MOST_PLACES, _FIRST = 6, 64


def runs(mask: NDArray[np.bool_]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """The first place of each run that is true, and the place behind its last."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]]).astype(np.int8)))
    return edges[::2], edges[1::2]


def summed(seconds: Array, values: Array, longest_s: float = math.inf) -> Array:
    """The integral over time up to each sample. Unknown values, and those of a longer gap, count nothing."""
    known, steps = np.nan_to_num(values), np.diff(seconds)
    return np.append(0.0, np.cumsum((known[1:] + known[:-1]) / 2 * np.where(steps > longest_s, 0, steps)))


def binned(times_s: Array, values: Array, width_s: float) -> Array:
    """The means of a column within bins of ``width_s`` from 0 on; NaN where a bin has no value."""
    at = (times_s / width_s).astype(np.int64)
    known = np.isfinite(values)
    n = int(at[-1]) + 1 if len(at) else 0
    count = np.bincount(at[known], minlength=n)
    total = np.bincount(at[known], weights=values[known], minlength=n)
    with np.errstate(invalid="ignore"):
        return np.asarray(total / np.where(count == 0, np.nan, count), dtype=np.float64)


def averaged(times_s: Array, columns: Sequence[Array], width_s: float) -> list[Array]:
    """The means of columns over ``width_s``, of the samples in which all are known."""
    rows = np.stack(columns)
    known = np.isfinite(rows).all(axis=0)
    if not known.any():
        return list(rows[:, :0])
    at = (times_s[known] / width_s).astype(np.int64)
    starts = np.flatnonzero(np.append(True, at[1:] != at[:-1]))
    counts = np.diff(np.append(starts, len(at)))
    return list(np.add.reduceat(rows[:, known], starts, axis=1) / counts)


def bridged(values: Array) -> Array:
    """The values with a straight line across their gaps; zeros if there is none."""
    known = np.isfinite(values)
    if known.all() or not known.any():
        return np.nan_to_num(values)
    at = np.arange(len(values))
    return np.interp(at, at[known], values[known])


def lagged(values: Array, steps: float) -> Array:
    """The response of a first-order lag of so many steps, from rest, at the end of each step; along the last
    axis."""
    keep = float(np.exp(-1 / steps))
    # The sum of a chunk's values, each divided by how far it has faded: by e^8 at most.
    chunk = max(1, int(_FADES * steps))
    fades = keep ** np.arange(chunk)
    n, before = values.shape[-1], values.shape[:-1]
    chunks = -(-n // chunk)
    padded = np.zeros((*before, chunks * chunk))
    padded[..., :n] = values
    answer = np.cumsum(padded.reshape(*before, chunks, chunk) / fades, axis=-1) * (fades * (1 - keep))
    state = np.zeros((*before, chunks))
    for i in range(1, chunks):
        state[..., i] = answer[..., i - 1, -1] + fades[-1] * keep * state[..., i - 1]
    answer += state[..., None] * (keep * fades)
    return np.asarray(answer.reshape(padded.shape)[..., :n], dtype=np.float64)


def smooth_basis(values: Array, pieces: int) -> list[Array]:
    """Columns whose sums are the smooth curves over the values' range: quadratic B-splines of so many pieces.

    They sum to 1 everywhere.
    """
    low, high = float(values.min()), float(values.max())
    at = np.clip((values - low) / max(high - low, 1e-12), 0, 1 - 1e-12) * pieces
    return [_spline(at - first) for first in range(-2, pieces)]


def _spline(u: Array) -> Array:
    inner = np.where(u < 2, (-2 * u**2 + 6 * u - 3) / 2, (3 - u) ** 2 / 2)
    return np.where((u < 0) | (u > 3), 0.0, np.where(u < 1, u**2 / 2, inner))


def resolution(values: Array) -> float:
    """The step of a sensor's values: their smallest difference; 0 if they have none."""
    different = np.unique(values[np.isfinite(values)])
    steps = np.diff(different)
    # Values that a float rounds differ by next to nothing.
    steps = steps[steps > 1e-6 * np.abs(different[1:])]
    return float(steps.min()) if len(steps) else 0.0


def quantum(values: Array) -> float:
    """The step in which values are reported, by their decimal places; if they have too many to tell, that of
    a 32-bit float."""
    first, largest = values[:_FIRST], float(np.abs(values).max(initial=0.0))
    for places in range(_MOST_PLACES + 1):
        if _whole(first * 10.0**places) and _whole(values * 10.0**places):
            return float(10.0**-places)
    return float(np.spacing(np.float32(largest)))


def _whole(values: Array) -> bool:
    return bool((np.abs(values - np.rint(values)) < 1e-9 * np.maximum(np.abs(values), 1.0)).all())
