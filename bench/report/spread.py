"""How values spread: percentiles of one run, and the range of the medians of repeated ones. Pure."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from statistics import median, quantiles


@dataclass(frozen=True)
class Spread:
    """Percentiles of ``n`` values, and between which the medians of the repeats lie."""

    n: int
    p50: float
    p95: float
    p99: float
    low: float
    high: float

    def text(self, unit: str = "ms", digits: int = 2) -> str:
        """``1.20 ms (p95 2.10, p99 3.00; 1.10 to 1.30)``; the range only of repeats."""
        tail = f"p95 {self.p95:.{digits}f}, p99 {self.p99:.{digits}f}"
        repeats = "" if self.low == self.high else f"; {self.low:.{digits}f} to {self.high:.{digits}f}"
        return f"{self.p50:.{digits}f} {unit} ({tail}{repeats})"


def spread(repeats: Sequence[Sequence[float]]) -> Spread | None:
    """The spread of all values of all repeats; None where nothing was measured."""
    medians = [median(values) for values in repeats if values]
    values = [value for repeat in repeats for value in repeat]
    if not values:
        return None
    cuts = quantiles(values, n=100, method="inclusive") if len(values) > 1 else values * 99
    return Spread(len(values), median(values), cuts[94], cuts[98], min(medians), max(medians))


def ratio(ours: Sequence[Sequence[float]], floor: Sequence[Sequence[float]]) -> float | None:
    """The median over the repeats of ours against the floor of the same repeat, so that a machine that
    is slow for a while is slow for both; None where there is no pair."""
    pairs = [
        median(one) / median(other)
        for one, other in zip(ours, floor, strict=False)
        if one and other and median(other) > 0
    ]
    return median(pairs) if pairs else None
