"""The matrix profile of a series: how far each stretch is from the one that is most like it.

Distances are those of Mueen's MASS: Euclidean, of stretches with mean 0 and deviation 1, by products in the
frequency domain.
"""

from __future__ import annotations

import numpy as np

from iort_analysis.mining.anomalies.readings import Array, Mask

# So many stretches are transformed together.
_TOGETHER = 256
# A stretch with less than this share of the whole series' deviation is flat: its shape is noise.
_FLAT = 0.02


def mass(stretches: Array, series: Array) -> Array:
    """The distance of each stretch (a row) from each place of a series; infinite for flat ones.

    Two stretches are sqrt(2 m) apart, or nearer, if they have nothing to do with each other.
    """
    m = stretches.shape[1]
    size = 1 << (len(series) + m - 1).bit_length()
    places = len(series) - m + 1
    ahead = np.fft.rfft(series - series.mean(), size)
    deviation = _moving_deviation(series - series.mean(), m)
    own = stretches - stretches.mean(axis=1, keepdims=True)
    own_deviation = own.std(axis=1)
    back = np.fft.rfft(own[:, ::-1], size, axis=1)
    products = np.fft.irfft(ahead * back, size, axis=1)[:, m - 1 : m - 1 + places]
    least = _FLAT * float(series.std())
    with np.errstate(divide="ignore", invalid="ignore"):
        # The stretches have the mean 0, so the place's mean drops out.
        alike = products / (m * deviation * own_deviation[:, None])
    far = np.sqrt(np.maximum(0.0, 2 * m * (1 - np.clip(alike, -1, 1))))
    far[:, ~(deviation > least)] = np.inf
    far[~(own_deviation > least)] = np.inf
    return np.asarray(far)


def matrix_profile(series: Array, m: int, usable: Mask | None = None) -> Array:
    """For each place the distance of its stretch of ``m`` values from the nearest one that does not overlap
    it by half. NaN where no stretch begins, or where it is flat or not ``usable``."""
    places = len(series) - m + 1
    if places < 2 * m:
        return np.full(max(places, 0), np.nan)
    stretches = np.lib.stride_tricks.sliding_window_view(series, m)
    allowed = np.ones(places, dtype=np.bool_) if usable is None else usable[:places]
    nearest = np.full(places, np.inf)
    offset = np.arange(places)
    wanted = np.flatnonzero(allowed)
    for first in range(0, len(wanted), _TOGETHER):
        chosen = wanted[first : first + _TOGETHER]
        far = mass(stretches[chosen], series)
        far[np.abs(offset[None, :] - chosen[:, None]) <= m // 2] = np.inf
        far[:, ~allowed] = np.inf
        nearest[chosen] = far.min(axis=1)
    return np.where(np.isfinite(nearest), nearest, np.nan)


def _moving_deviation(series: Array, m: int) -> Array:
    sums = np.cumsum(np.insert(series, 0, 0.0))
    squares = np.cumsum(np.insert(series**2, 0, 0.0))
    mean = (sums[m:] - sums[:-m]) / m
    variance = (squares[m:] - squares[:-m]) / m - mean**2
    return np.asarray(np.sqrt(np.maximum(variance, 0.0)))
