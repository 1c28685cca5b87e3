"""Trends over drives, by the slopes between all pairs (Theil and Sen)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from iort_analysis.statistics.intervals import sides
from iort_analysis.statistics.student import tail
from iort_contract.messages.analysis import Estimate

US_PER_DAY = 86_400_000_000
# The slopes between pairs take memory of the square of this.
_MOST = 500


class Trend(NamedTuple):
    """A change per day, the days it was seen over, and the chance of such a rise and of such a fall."""

    per_day: Estimate
    days: float
    p_up: float
    p_down: float


def trend(times_us: Sequence[int], values: Sequence[float], unit: str) -> Trend:
    """The trend of at least two values at different times; of the newest 500 of them."""
    times = np.asarray(times_us[-_MOST:], dtype=np.int64)
    found = np.asarray(values[-_MOST:], dtype=float)
    days = (times - times[0]) / US_PER_DAY
    one, other = np.triu_indices(len(days), 1)
    apart, up = days[other] - days[one], found[other] - found[one]
    slopes = np.sort(up[apart != 0] / apart[apart != 0])
    n, pairs = len(found), len(slopes)
    concordance = float(np.sign(slopes).sum())
    # The variance of the number of rising pairs less the falling ones, with ties among the values.
    ties = np.unique(found, return_counts=True)[1]
    variance = (n * (n - 1) * (2 * n + 5) - float((ties * (ties - 1) * (2 * ties + 5)).sum())) / 18
    deviation = math.sqrt(max(variance, 0.0)) or math.inf
    half = sides() * deviation if math.isfinite(deviation) else 0.0
    # Sen's ends, outwards from where they fall between two slopes.
    low, high = math.floor((pairs - half) / 2) - 1, math.ceil((pairs + half) / 2)
    per_day = Estimate(
        float(np.median(slopes)), float(slopes[max(low, 0)]), float(slopes[min(high, pairs - 1)]), f"{unit}/d"
    )
    p_up = tail((concordance - 1) / deviation, math.inf)
    p_down = tail((-concordance - 1) / deviation, math.inf)
    return Trend(per_day, float(days.max() - days.min()), p_up, p_down)
