"""The normal distribution on arrays: numpy has no distribution function."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

# Abramowitz and Stegun, 26.2.17: an error below 7.5e-8.
_P = 0.2316419
_B = (0.319381530, -0.356563782, 1.781477937, -1.821255978, 1.330274429)
_LEAST = 1e-9


def density(x: Array) -> Array:
    """The density of the standard normal distribution."""
    return np.asarray(np.exp(-0.5 * x * x) / np.sqrt(2 * np.pi), dtype=np.float64)


def above(x: Array) -> Array:
    """The chance of more than x."""
    t = 1 / (1 + _P * np.abs(x))
    tail = density(x) * t * (_B[0] + t * (_B[1] + t * (_B[2] + t * (_B[3] + t * _B[4]))))
    return np.where(x > 0, tail, 1 - tail)


def between(low: Array, high: Array) -> tuple[Array, Array, Array]:
    """Of the logarithm of the chance to be between ``low`` and ``high``: its first derivative when both fall,
    minus the second (0 to 1), and its derivative when both shrink to 0 as by a growing deviation."""
    chance = np.maximum(above(low) - above(high), _LEAST)
    at_low, at_high = density(low), density(high)
    slope = (at_low - at_high) / chance
    spread = (low * at_low - high * at_high) / chance
    return slope, np.clip(slope**2 - spread, 0.0, 1.0), spread
