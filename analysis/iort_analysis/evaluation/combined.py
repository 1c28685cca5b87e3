"""Several drives' estimates of a parameter as one."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from iort_analysis.statistics.intervals import sides
from iort_contract.messages.analysis import Estimate


def combined(estimates: Sequence[Estimate]) -> Estimate:
    """The mean of at least one drive's estimates.

    What the drives differ by beyond their intervals widens the mean's (DerSimonian and Laird's model, with
    Hartung and Knapp's interval): two drives that disagree say little.
    """
    if len(estimates) == 1:
        return estimates[0]
    values = np.array([one.value for one in estimates])
    errors = np.array([(one.high - one.low) / 2 / sides() for one in estimates])
    errors = np.maximum(errors, 1e-9 * max(float(np.abs(values).max()), 1e-12))
    weights, among = errors**-2.0, len(values) - 1
    surplus = float((weights * (values - np.average(values, weights=weights)) ** 2).sum()) - among
    scaled = float(weights.sum() - (weights**2).sum() / weights.sum())
    # 0 where one drive is so much surer than the others that its weight is the whole.
    between = max(0.0, surplus / scaled) if scaled > 0 else 0.0
    weights = 1 / (errors**2 + between)
    mean = float(np.average(values, weights=weights))
    scatter = float((weights * (values - mean) ** 2).sum()) / among
    # Drives that agree by chance are no reason for less than their own errors give.
    known = sides() / math.sqrt(float(weights.sum()))
    reach = max(known, sides(among) * math.sqrt(scatter / float(weights.sum())))
    return Estimate(mean, mean - reach, mean + reach, estimates[0].unit)
