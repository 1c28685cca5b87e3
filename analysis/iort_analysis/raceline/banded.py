"""Solves cyclic banded systems, which numpy has no solver for."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

# A block has to hold the band; larger ones spend more on arithmetic and less on calls.
_BLOCK = 24


def solve(diagonals: NDArray[np.float64], right: NDArray[np.float64]) -> NDArray[np.float64]:
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


def product(diagonals: NDArray[np.float64], x: NDArray[np.float64]) -> NDArray[np.float64]:
    """A x, for the same A."""
    total = diagonals[0] * x
    for k in (1, 2):
        total = total + diagonals[k] * np.roll(x, -k) + np.roll(diagonals[k] * x, k)
    return np.asarray(total)


def _part(
    diagonals: NDArray[np.float64], rows: NDArray[np.int64], columns: NDArray[np.int64]
) -> NDArray[np.float64]:
    """A[rows][:, columns]."""
    n = diagonals.shape[1]
    apart = (columns[None, :] - rows[:, None]) % n
    above = np.where(apart <= 2, diagonals[np.minimum(apart, 2), rows[:, None]], 0.0)
    below = np.where(n - apart <= 2, diagonals[np.minimum((n - apart) % n, 2), columns[None, :]], 0.0)
    return np.where(apart <= 2, above, below)
