"""Quadratic programmes with bounds, and the cyclic banded systems in them."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from iort_analysis.statistics.signals import Array

# A block has to hold the band; larger ones spend more on arithmetic and less on calls.
_BLOCK = 24


def solve(diagonals: Array, right: Array) -> Array:
    """The solution x of A x = right, for a symmetric positive definite A of five cyclic diagonals.

    ``diagonals[k, i]`` is A[i, (i + k) % n] for k = 0, 1, 2. The unknowns are cut into blocks. The last one
    closes the circle: it is solved for by itself, after all others are eliminated in order.
    """
    n = right.size
    count = max(3, n // _BLOCK)
    edges = np.linspace(0, n, count + 1).astype(int)
    blocks = [np.arange(first, last) for first, last in pairwise(edges)]
    last = blocks.pop()
    border = [_part(diagonals, block, last) for block in blocks]
    # Eliminate forward: each block's matrix, and its right side beside its coupling to the last block.
    factors, sides, above = [], [], None
    for i, block in enumerate(blocks):
        matrix, side = _part(diagonals, block, block), np.column_stack([right[block], border[i]])
        if above is not None:
            coupling = _part(diagonals, blocks[i - 1], block)
            matrix = matrix - coupling.T @ above[:, : block.size]
            side = side - coupling.T @ above[:, block.size :]
        after = _part(diagonals, block, blocks[i + 1]) if i + 1 < len(blocks) else np.zeros((block.size, 0))
        solved = np.linalg.solve(matrix, np.column_stack([after, side]))
        factors.append(solved[:, : after.shape[1]])
        sides.append(solved[:, after.shape[1] :])
        above = solved if after.shape[1] else None
    # Substitute back.
    for i in range(len(blocks) - 2, -1, -1):
        sides[i] = sides[i] - factors[i] @ sides[i + 1]
    matrix, side = _part(diagonals, last, last), right[last]
    for coupling, solved in zip(border, sides, strict=True):
        matrix = matrix - coupling.T @ solved[:, 1:]
        side = side - coupling.T @ solved[:, 0]
    end = np.linalg.solve(matrix, side)
    return np.concatenate([*(solved[:, 0] - solved[:, 1:] @ end for solved in sides), end])


def product(diagonals: Array, x: Array) -> Array:
    """A x, for the same A."""
    total = diagonals[0] * x
    for k in (1, 2):
        total = total + diagonals[k] * np.roll(x, -k) + np.roll(diagonals[k] * x, k)
    return np.asarray(total)


def _part(diagonals: Array, rows: NDArray[np.int64], columns: NDArray[np.int64]) -> Array:
    """A[rows][:, columns]."""
    n = diagonals.shape[1]
    apart = (columns[None, :] - rows[:, None]) % n
    above = np.where(apart <= 2, diagonals[np.minimum(apart, 2), rows[:, None]], 0.0)
    below = np.where(n - apart <= 2, diagonals[np.minimum((n - apart) % n, 2), columns[None, :]], 0.0)
    return np.where(apart <= 2, above, below)


# A quadratic programme with a bound below and above each unknown, by a primal-dual interior point method.
#
# Source: Nocedal and Wright, Numerical Optimization, 2nd edition, section 16.6, with Mehrotra's predictor and
# corrector. The bounds are only on the diagonal of Newton's system, so it stays banded.

_STEPS, _ENOUGH = 60, 1e-8
# The share of the way to a bound that a step goes.
_SHARE = 0.995


def minimum(hessian: Array, gradient: Array, low: Array, high: Array) -> Array:
    """The x from low to high with the least x H x / 2 + gradient x, for H as `solve` takes it."""
    x = (low + high) / 2
    scale = max(float(np.abs(gradient).max()), 1e-12)
    z_below, z_above = np.full_like(x, scale), np.full_like(x, scale)
    for _ in range(_STEPS):
        slope = product(hessian, x) + gradient - z_below + z_above
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
_Step = tuple[Array, Array, Array]


@dataclass(frozen=True)
class _Iterate:
    """A point strictly within its bounds: its distances from them, their multipliers, and the slope of the
    Lagrangian."""

    hessian: Array
    slope: Array
    below: Array
    above: Array
    z_below: Array
    z_above: Array

    @property
    def gap(self) -> float:
        """The mean product of a distance and its multiplier: 0 at the solution."""
        return float(self.below @ self.z_below + self.above @ self.z_above) / (2 * self.below.size)

    def step(self, to_below: Array, to_above: Array) -> _Step:
        """Newton's step to these products of distances and multipliers."""
        system = self.hessian.copy()
        system[0] += self.z_below / self.below + self.z_above / self.above
        push, pull = to_below / self.below - self.z_below, to_above / self.above - self.z_above
        move = solve(system, push - pull - self.slope)
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
