"""A baseline: what earlier drives let expect of the next one, by a robust random-effects model."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from iort_analysis.statistics.intervals import sides
from iort_analysis.statistics.student import tail
from iort_contract.messages.analysis import Estimate

# How many drives the catalogue's word on a healthy car's spread is worth.
_PRIOR_DRIVES = 4
# A drive further out than this many standard deviations counts as being there.
_CLIPPED = 3.0
_MAD = 1.4826


class Baseline(NamedTuple):
    """The mean over drives with its standard error, and the standard deviation from drive to drive.

    ``freedom`` is the degrees of freedom with which they are known, ``drives`` their number; for a fleet that
    of the robots.
    """

    value: float
    error: float
    spread: float
    freedom: float
    drives: int

    def change(self, found: Estimate) -> tuple[Estimate, float, float]:
        """The estimate's difference from the baseline with its interval, and the chances of a difference at
        least as far up, and as far down, in a drive that is like the others."""
        above = found.value >= self.value
        own = (found.value - found.low if above else found.high - found.value) / sides()
        scatter = math.sqrt(self.error**2 + self.spread**2 + own**2)
        off = found.value - self.value
        reach = sides(self.freedom) * math.hypot(self.error, own)
        up = tail(off / scatter, self.freedom)
        return Estimate(off, off - reach, off + reach, found.unit), up, 1 - up

    def interval(self, unit: str) -> Estimate:
        """What another healthy drive would give, itself measured without error."""
        reach = sides(self.freedom) * math.hypot(self.error, self.spread)
        return Estimate(self.value, self.value - reach, self.value + reach, unit)


def baseline(estimates: Sequence[Estimate], expected_spread: float) -> Baseline:
    """The baseline of at least one estimate.

    Each estimate's own interval is its error of measurement; what the estimates differ by beyond it is the
    spread from drive to drive (DerSimonian and Laird). Since a few drives tell little of the spread,
    ``expected_spread`` takes part as that of four drives. Outliers are clipped, so that one bad drive
    among the earlier ones moves little.
    """
    values = np.array([estimate.value for estimate in estimates])
    errors = np.array([max(e.high - e.low, 0.0) / 2 / sides() for e in estimates])
    errors = np.maximum(errors, max(1e-3 * expected_spread, 1e-12))
    middle = float(np.median(values))
    scale = max(_MAD * float(np.median(np.abs(values - middle))), expected_spread)
    reach = _CLIPPED * np.hypot(scale, errors)
    values = np.clip(values, middle - reach, middle + reach)
    among = len(values) - 1
    weights = errors**-2.0
    off = values - np.average(values, weights=weights)
    surplus = float((weights * off**2).sum()) - among
    scaled = float(weights.sum() - (weights**2).sum() / weights.sum())
    # 0 also where one drive is so much surer than the others that its weight is the whole.
    between = max(0.0, surplus / scaled) if scaled > 0 else 0.0
    freedom = among + _PRIOR_DRIVES
    variance = (among * between + _PRIOR_DRIVES * expected_spread**2) / freedom
    weights = 1 / (errors**2 + variance)
    return Baseline(
        float(np.average(values, weights=weights)),
        float(weights.sum()) ** -0.5,
        math.sqrt(variance),
        freedom,
        len(values),
    )


def fleet_baseline(robots: Sequence[Sequence[Estimate]], expected_spread: float) -> Baseline:
    """The baseline of a robot without earlier drives, from the drives of at least one other robot."""
    own = [baseline(drives, expected_spread) for drives in robots]
    means = [
        Estimate(one.value, one.value - sides() * one.error, one.value + sides() * one.error, "")
        for one in own
    ]
    between = baseline(means, 2 * expected_spread)
    within = math.sqrt(sum(one.spread**2 for one in own) / len(own))
    return between._replace(spread=math.hypot(between.spread, within))
