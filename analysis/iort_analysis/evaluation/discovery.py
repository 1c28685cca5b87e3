"""The correction for many tests: the false discovery rate."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np


def false_discovery_rates(p_values: Sequence[float]) -> list[float]:
    """For each test the rate of false discoveries among all that are at least as significant.

    By Benjamini and Yekutieli: right whatever the tests have to do with each other, and the parameters of one
    drive have much.
    """
    p = np.asarray(p_values, dtype=float)
    if not len(p):
        return []
    order = np.argsort(p, kind="stable")
    ranks = np.arange(1, len(p) + 1)
    scaled = p[order] * len(p) * (1 / ranks).sum() / ranks
    rates = np.empty(len(p))
    rates[order] = np.minimum(1.0, np.minimum.accumulate(scaled[::-1])[::-1])
    found: list[float] = rates.tolist()
    return found
