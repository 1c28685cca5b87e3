"""Intervals of means and shares."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

# 95 % quantiles of Student's t for 1, 2, ... degrees of freedom, and of the normal distribution.
_T95 = (6.314, 2.920, 2.353, 2.132, 2.015, 1.943, 1.895, 1.860, 1.833, 1.812)
_Z95 = 1.6449


def t95(degrees: int) -> float:
    """The half width of a 90 % interval in standard errors, by Student's t."""
    if degrees <= len(_T95):
        return _T95[degrees - 1]
    # Cornish and Fisher's expansion.
    z, v = _Z95, degrees
    return z + (z**3 + z) / (4 * v) + (5 * z**5 + 16 * z**3 + 3 * z) / (96 * v**2)


def mean_of(values: NDArray[np.float64]) -> tuple[float, float, float]:
    """The mean of at least two values, and its 90 % interval."""
    mean, n = float(values.mean()), len(values)
    either = t95(n - 1) * float(values.std(ddof=1)) / math.sqrt(n)
    return mean, mean - either, mean + either


def share_of(hits: float, n: float) -> tuple[float, float, float]:
    """A share of n independent trials, and its 90 % interval by Wilson."""
    share, z2 = hits / n, _Z95**2
    middle = (share + z2 / (2 * n)) / (1 + z2 / n)
    either = _Z95 / (1 + z2 / n) * math.sqrt(share * (1 - share) / n + z2 / (4 * n**2))
    return share, max(0.0, middle - either), min(1.0, middle + either)
