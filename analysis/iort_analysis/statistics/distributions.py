"""Distributions that numpy lacks, normal and Student's t, and intervals of means."""

from __future__ import annotations

import math
from functools import cache

import numpy as np

from iort_analysis.statistics.signals import Array, quantum
from iort_contract.messages.analysis import INTERVAL

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


# Student's t distribution: its tail and its quantiles.

# The continued fraction converges in far fewer steps for every number of degrees of freedom in use.
_STEPS = 300
_TINY = 1e-300


def tail(t: float, freedom: float) -> float:
    """The chance of a value above ``t``."""
    if math.isinf(freedom):
        return math.erfc(t / math.sqrt(2)) / 2
    beyond = _incomplete_beta(freedom / (freedom + t * t), freedom / 2, 0.5) / 2
    return beyond if t > 0 else 1 - beyond


def quantile(p: float, freedom: float) -> float:
    """The value that a share ``p`` of all lies below; ``p`` from 0.5 on."""
    low, high = 0.0, 1.0
    while tail(high, freedom) > 1 - p:
        low, high = high, 2 * high
    for _ in range(60):
        middle = (low + high) / 2
        low, high = (middle, high) if tail(middle, freedom) > 1 - p else (low, middle)
    return (low + high) / 2


def _incomplete_beta(x: float, a: float, b: float) -> float:
    """The regularised incomplete beta function, by Lentz' continued fraction."""
    if x <= 0 or x >= 1:
        return float(x >= 1)
    if x > (a + 1) / (a + b + 2):
        return 1 - _incomplete_beta(1 - x, b, a)
    log_front = math.lgamma(a + b) - math.lgamma(a) - math.lgamma(b) + a * math.log(x) + b * math.log1p(-x)
    c, d = 1.0, 1 / _away(1 - (a + b) * x / (a + 1))
    fraction = d
    for m in range(1, _STEPS):
        even = m * (b - m) * x / ((a + 2 * m - 1) * (a + 2 * m))
        odd = -(a + m) * (a + b + m) * x / ((a + 2 * m) * (a + 2 * m + 1))
        for term in (even, odd):
            d = 1 / _away(1 + term * d)
            c = _away(1 + term / c)
            fraction *= c * d
        if abs(c * d - 1) < 1e-14:
            break
    return math.exp(log_front) * fraction / a


def _away(value: float) -> float:
    return value if abs(value) > _TINY else _TINY


# Intervals of means.


@cache
def sides(freedom: float = math.inf) -> float:
    """The half width of an `INTERVAL` in standard errors, by Student's t; of the normal distribution without
    degrees of freedom."""
    return quantile((1 + INTERVAL) / 2, freedom)


def mean_of(values: Array) -> tuple[float, float, float]:
    """The mean of at least two values, and its interval: at least the step in which they are reported."""
    mean, n = float(values.mean()), len(values)
    either = sides(n - 1) * float(values.std(ddof=1)) / math.sqrt(n)
    either = max(either, sides() * quantum(values) / math.sqrt(12 * len(np.unique(values))))
    return mean, mean - either, mean + either
