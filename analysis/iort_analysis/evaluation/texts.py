"""The sentences of findings."""

from __future__ import annotations

import math
from collections.abc import Sequence

from iort_analysis.evaluation.baselines import Baseline
from iort_contract.catalog.analysis import KINDS
from iort_contract.catalog.entries import Parameter
from iort_contract.messages.analysis import Estimate, Finding


def changed(parameter: Parameter, found: Estimate, expected: Baseline, whose: str) -> str:
    """What a parameter is, and what was expected."""
    over = f"{expected.drives} {'earlier drives' if whose == 'its own' else 'other robots'}"
    return (
        f"{parameter.meaning}: {_with_interval(found)}, "
        f"{_compared(found.value - expected.value, expected.value, found.unit)} {whose} baseline of "
        f"{_number(expected.value, found.unit)} over {over}"
    )


def trending(parameter: Parameter, newest: Estimate, change: Estimate, days: float) -> str:
    """How a parameter developed."""
    way = "rose" if change.value > 0 else "fell"
    low, high = sorted((abs(change.low), abs(change.high)))
    by = f"{_number(abs(change.value), change.unit)} ({_digits(low)} to {_digits(high)})"
    return f"{parameter.meaning}: {way} by {by} in {days:.0f} days, to {_number(newest.value, newest.unit)}"


def complete(finding: Finding, explained: Sequence[Finding]) -> str:
    """The finding's text with the others that it explains, and with what else the cause may be."""
    sentences = [finding.text]
    if explained:
        sentences.append("This goes with it: " + "; ".join(other.text for other in explained))
    if alternatives := KINDS[finding.kind].alternatives:
        sentences.append(f"The data cannot tell this from {' or '.join(alternatives)}")
    return ". ".join(sentences)


def rounded(estimate: Estimate) -> Estimate:
    """The estimate with the digits that it deserves: three of its interval's width, or six without one."""
    size = estimate.high - estimate.low or 1e-3 * abs(estimate.value)
    if not size:
        return estimate
    places = 2 - math.floor(math.log10(size))
    value, low, high = (round(float(each), places) for each in estimate[:3])
    return Estimate(value, low, high, estimate.unit)


def _with_interval(estimate: Estimate) -> str:
    value, low, high, unit = estimate
    return f"{_number(value, unit)} ({_digits(low)} to {_digits(high)})"


def _compared(change: float, baseline: float, unit: str) -> str:
    way = "above" if change > 0 else "below"
    # A share of nearly nothing says nothing.
    if abs(baseline) > abs(change) / 10:
        return f"{abs(change / baseline):.0%} {way}"
    return f"{_number(abs(change), unit)} {way}"


def _number(value: float, unit: str) -> str:
    return _digits(value) if unit == "1" else f"{_digits(value)} {unit}"


def _digits(value: float) -> str:
    """Three digits, or all before the point."""
    return f"{value:.0f}" if abs(value) >= 1000 else f"{value:.3g}"
