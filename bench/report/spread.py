"""Percentiles of a run, and the range of the medians of repeated runs. Pure functions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from statistics import median, quantiles

from bench.report.result import NOT_MEASURED


@dataclass(frozen=True)
class Spread:
    """Percentiles of ``n`` values, and the least and the greatest median of the repeats."""

    n: int
    p50: float
    p95: float
    p99: float
    low: float
    high: float

    def text(self, unit: str = "ms", digits: int = 2) -> str:
        """``1.20 ms (p95 2.10, p99 3.00; 1.10 to 1.30)``; only repeats have a range."""
        tail = f"p95 {self.p95:.{digits}f}, p99 {self.p99:.{digits}f}"
        repeats = "" if self.low == self.high else f"; {self.low:.{digits}f} to {self.high:.{digits}f}"
        return f"{self.p50:.{digits}f} {unit} ({tail}{repeats})"


def spread(repeats: Sequence[Sequence[float]]) -> Spread | None:
    """Return the spread of all values of all repeats; None without values."""
    medians = [median(values) for values in repeats if values]
    values = [value for repeat in repeats for value in repeat]
    if not values:
        return None
    cuts = quantiles(values, n=100, method="inclusive") if len(values) > 1 else values * 99
    return Spread(len(values), median(values), cuts[94], cuts[98], min(medians), max(medians))


def text(repeats: Sequence[Sequence[float]], unit: str = "ms", digits: int = 2) -> str:
    """Return the spread as text; a dash without values."""
    found = spread(repeats)
    return found.text(unit, digits) if found else NOT_MEASURED


def rounded(ways: Mapping[str, Sequence[Sequence[float]]], digits: int) -> dict[str, dict[str, float]]:
    """Return the spread of each way as numbers, for the values behind a report."""
    spreads = {name: spread(repeats) for name, repeats in ways.items()}
    return {
        name: {key: round(value, digits) for key, value in asdict(one).items()}
        for name, one in spreads.items()
        if one
    }


def ratio(ours: Sequence[Sequence[float]], floor: Sequence[Sequence[float]]) -> float | None:
    """Return the median, over the repeats, of ours / floor in the same repeat; None without a pair.

    A machine that is slow for a while slows both halves of a pair.
    """
    pairs = [
        median(one) / median(other)
        for one, other in zip(ours, floor, strict=False)
        if one and other and median(other) > 0
    ]
    return median(pairs) if pairs else None
