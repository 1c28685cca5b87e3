"""Baselines, means and trends over several drives' estimates of a parameter."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from iort_analysis.statistics.distributions import sides, tail
from iort_analysis.statistics.signals import MAD_TO_SIGMA, Array
from iort_contract.messages.analysis import Estimate

# How many drives the catalogue's word on a healthy car's spread is worth.
_PRIOR_DRIVES = 4
# A drive further out than this many standard deviations counts as being there.
_CLIPPED = 3.0


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
    scale = max(MAD_TO_SIGMA * float(np.median(np.abs(values - middle))), expected_spread)
    reach = _CLIPPED * np.hypot(scale, errors)
    values = np.clip(values, middle - reach, middle + reach)
    among = len(values) - 1
    freedom = among + _PRIOR_DRIVES
    variance = (among * _between(values, errors) + _PRIOR_DRIVES * expected_spread**2) / freedom
    weights = 1 / (errors**2 + variance)
    return Baseline(
        float(np.average(values, weights=weights)),
        float(weights.sum()) ** -0.5,
        math.sqrt(variance),
        freedom,
        len(values),
    )


def _between(values: Array, errors: Array) -> float:
    """The variance by which values differ beyond their errors (DerSimonian and Laird)."""
    weights = errors**-2.0
    off = values - np.average(values, weights=weights)
    surplus = float((weights * off**2).sum()) - (len(values) - 1)
    scaled = float(weights.sum() - (weights**2).sum() / weights.sum())
    # 0 also where one drive is so much surer than the others that its weight is the whole.
    return max(0.0, surplus / scaled) if scaled > 0 else 0.0


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


# Several drives' estimates of a parameter as one.


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
    among = len(values) - 1
    weights = 1 / (errors**2 + _between(values, errors))
    mean = float(np.average(values, weights=weights))
    scatter = float((weights * (values - mean) ** 2).sum()) / among
    # Drives that agree by chance are no reason for less than their own errors give.
    known = sides() / math.sqrt(float(weights.sum()))
    reach = max(known, sides(among) * math.sqrt(scatter / float(weights.sum())))
    return Estimate(mean, mean - reach, mean + reach, estimates[0].unit)


# Trends over drives, by the slopes between all pairs (Theil and Sen).

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
