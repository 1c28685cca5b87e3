"""A change within a drive: the cumulative sum of a model's residuals (CUSUM)."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from iort_analysis.mining.anomalies.readings import Array
from iort_analysis.statistics.intervals import sides
from iort_contract.messages.analysis import Estimate

_LEAST = 30
# Before and after a change there is at least this share of the series.
_SHARE = 0.1


class Change(NamedTuple):
    """The first value after a change of the mean, the change, and its chance if there was none."""

    place: int
    effect: Estimate
    p: float


def changed(values: Array, unit: str) -> Change | None:
    """The most likely change of the mean of a series; None for a short or constant one.

    The chance is that of the largest distance of a Brownian bridge, as for Kolmogorov's test. The deviation
    is that of means over long times (Bartlett's window), so that neighbours may be alike.
    """
    n = len(values)
    if n < _LEAST:
        return None
    sums = np.cumsum(values - values.mean())
    margin = max(2, round(_SHARE * n))
    places = np.arange(margin, n - margin + 1)
    away = np.abs(sums[places - 1])
    # The two pieces of the least squares: where the sum itself is largest would lie too near the middle.
    place = int(places[np.argmax(away**2 / (places * (n - places)))])
    before, after = values[:place], values[place:]
    # About their own means, or a change would hide itself.
    within = np.concatenate([before - before.mean(), after - after.mean()])
    deviation = _long_run(within)
    if not deviation:
        return None
    distance = float(away.max()) / (deviation * math.sqrt(n))
    value = float(after.mean() - before.mean())
    half = sides() * deviation * math.sqrt(1 / len(before) + 1 / len(after))
    return Change(place, Estimate(value, value - half, value + half, unit), _beyond(distance))


def _long_run(values: Array) -> float:
    """The deviation that the mean of n values has, times the root of n."""
    n = len(values)
    lags = round(2 * n ** (1 / 3))
    variance = float(values @ values) / n
    for lag in range(1, lags + 1):
        variance += 2 * (1 - lag / (lags + 1)) * float(values[lag:] @ values[:-lag]) / n
    # Two means were taken out at the place that fits best, and the window cuts off what lies beyond it: that
    # hides the more of the deviation, the longer the window is.
    hidden = n / (n - 2 * (lags + 1))
    return float(hidden * math.sqrt(max(variance, float(values @ values) / n / 4)))


def _beyond(distance: float) -> float:
    """The chance that a Brownian bridge goes further than this."""
    if distance < 0.3:
        return 1.0
    terms = (2 * (-1) ** (k + 1) * math.exp(-2 * (k * distance) ** 2) for k in range(1, 20))
    return min(1.0, max(0.0, math.fsum(terms)))
