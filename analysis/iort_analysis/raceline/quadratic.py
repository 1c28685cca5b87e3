"""A quadratic programme with a bound below and above each unknown, by a primal-dual interior point method.

Source: Nocedal and Wright, Numerical Optimization, 2nd edition, section 16.6, with Mehrotra's predictor and
corrector. The bounds are only on the diagonal of Newton's system, so it stays banded.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from iort_analysis.raceline import banded

_STEPS, _ENOUGH = 60, 1e-8
# The share of the way to a bound that a step goes.
_SHARE = 0.995


def minimum(
    hessian: NDArray[np.float64],
    gradient: NDArray[np.float64],
    low: NDArray[np.float64],
    high: NDArray[np.float64],
) -> NDArray[np.float64]:
    """The x from low to high with the least x H x / 2 + gradient x, for H as `banded.solve` takes it."""
    x = (low + high) / 2
    scale = max(float(np.abs(gradient).max()), 1e-12)
    z_below, z_above = np.full_like(x, scale), np.full_like(x, scale)
    for _ in range(_STEPS):
        slope = banded.product(hessian, x) + gradient - z_below + z_above
        at = _Iterate(hessian, slope, x - low, high - x, z_below, z_above)
        if at.gap < _ENOUGH * scale * float((high - low).mean()) and np.abs(slope).max() < _ENOUGH * scale:
            break
        nothing = np.zeros_like(x)
        predicted = at.step(nothing, nothing)
        move, d_below, d_above = predicted
        centre = at.gap * (at.gap_after(predicted, min(1.0, at.longest(predicted))) / at.gap) ** 3
        corrected = at.step(centre - move * d_below, centre + move * d_above)
        length = min(1.0, _SHARE * at.longest(corrected))
        x = x + length * corrected[0]
        z_below, z_above = z_below + length * corrected[1], z_above + length * corrected[2]
    return x


# How x and both multipliers move.
_Step = tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]


@dataclass(frozen=True)
class _Iterate:
    """A point strictly within its bounds: its distances from them, their multipliers, and the slope of the
    Lagrangian."""

    hessian: NDArray[np.float64]
    slope: NDArray[np.float64]
    below: NDArray[np.float64]
    above: NDArray[np.float64]
    z_below: NDArray[np.float64]
    z_above: NDArray[np.float64]

    @property
    def gap(self) -> float:
        """The mean product of a distance and its multiplier: 0 at the solution."""
        return float(self.below @ self.z_below + self.above @ self.z_above) / (2 * self.below.size)

    def step(self, to_below: NDArray[np.float64], to_above: NDArray[np.float64]) -> _Step:
        """Newton's step to these products of distances and multipliers."""
        system = self.hessian.copy()
        system[0] += self.z_below / self.below + self.z_above / self.above
        push, pull = to_below / self.below - self.z_below, to_above / self.above - self.z_above
        move = banded.solve(system, push - pull - self.slope)
        return move, push - self.z_below * move / self.below, pull + self.z_above * move / self.above

    def gap_after(self, step: _Step, length: float) -> float:
        """The gap so far along a step."""
        move, d_below, d_above = (length * part for part in step)
        products = (self.below + move) @ (self.z_below + d_below)
        return float(products + (self.above - move) @ (self.z_above + d_above)) / (2 * move.size)

    def longest(self, step: _Step) -> float:
        """The longest step, up to 1 / `_SHARE`, along which distances and multipliers stay positive."""
        move, d_below, d_above = step
        most = 1 / _SHARE
        for value, change in (
            (self.below, move), (self.above, -move), (self.z_below, d_below), (self.z_above, d_above),
        ):  # fmt: skip
            falls = change < 0
            if falls.any():
                most = min(most, float((-value[falls] / change[falls]).min()))
        return most
