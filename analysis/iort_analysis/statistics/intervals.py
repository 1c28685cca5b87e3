"""Intervals of means and shares."""

from __future__ import annotations

import math
from functools import cache

import numpy as np
from numpy.typing import NDArray

from iort_analysis.statistics.signals import quantum
from iort_analysis.statistics.student import quantile
from iort_contract.messages.analysis import INTERVAL


@cache
def sides(freedom: float = math.inf) -> float:
    """The half width of an `INTERVAL` in standard errors, by Student's t; of the normal distribution without
    degrees of freedom."""
    return quantile((1 + INTERVAL) / 2, freedom)


def mean_of(values: NDArray[np.float64]) -> tuple[float, float, float]:
    """The mean of at least two values, and its interval: at least the step in which they are reported."""
    mean, n = float(values.mean()), len(values)
    either = sides(n - 1) * float(values.std(ddof=1)) / math.sqrt(n)
    either = max(either, sides() * quantum(values) / math.sqrt(12 * len(np.unique(values))))
    return mean, mean - either, mean + either


def share_of(hits: float, n: float) -> tuple[float, float, float]:
    """A share of n independent trials, and its interval by Wilson."""
    share, z = hits / n, sides()
    middle = (share + z**2 / (2 * n)) / (1 + z**2 / n)
    either = z / (1 + z**2 / n) * math.sqrt(share * (1 - share) / n + z**2 / (4 * n**2))
    return share, max(0.0, middle - either), min(1.0, middle + either)
