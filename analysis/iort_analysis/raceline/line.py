"""The line of least curvature: the integral of its square over the lap's length is the least.

Source: Heilmeier, Wischnewski, Hermansdorfer, Betz, Lienkamp and Lohmann, Minimum curvature trajectory
planning and control for an autonomous race car, Vehicle System Dynamics 58 (2020), equations 4 to 15. They
linearise the curvature once, with splines; here it is linearised again at each step (Gauss-Newton), with
differences of neighbouring points, which keeps the quadratic programme banded.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from iort_analysis.raceline import quadratic
from iort_analysis.raceline.reference import Reference

_STEPS, _ENOUGH, _HALVES = 40, 1e-6, 12
# Added to the Hessian's diagonal, relative to its mean: a shift of a whole circle changes no curvature.
_RIDGE = 1e-7


def least_curvature(track: Reference) -> NDArray[np.float64]:
    """The offsets to the left of the line of least curvature, in metres."""
    offset = np.clip(np.zeros_like(track.low), track.low, track.high)
    now = _cost(track, offset)
    for _ in range(_STEPS):
        rows, residual = _linear(track, offset)
        hessian, gradient = _normal(rows, residual)
        hessian[0] += _RIDGE * hessian[0].mean()
        move = quadratic.minimum(hessian, gradient, track.low - offset, track.high - offset)
        length = 1.0
        for _ in range(_HALVES):
            tried = _cost(track, offset + length * move)
            if tried < now:
                break
            length /= 2
        else:
            break
        offset = offset + length * move
        gained, now = now - tried, tried
        if gained < _ENOUGH * now:
            break
    return offset


def _cost(track: Reference, offset: NDArray[np.float64]) -> float:
    """The integral of the squared curvature, 1/m."""
    residual = _residual(track.line(offset))
    return float(residual @ residual)


def _residual(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """What squares and sums to the integral: the curvature times the root of the length."""
    first, second, length = _differences(points)
    return np.asarray(_cross(first, second) / length**2.5)


def _linear(track: Reference, offset: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The residual, and its derivatives by the offset of the point behind, the point, and the one ahead."""
    first, second, length = _differences(track.line(offset))
    bend = _cross(first, second)
    rows = []
    for shift, d_first, d_second in ((1, -0.5, 1.0), (0, 0.0, -2.0), (-1, 0.5, 1.0)):
        across = np.roll(track.across, shift, axis=0)
        d_bend = _cross(d_first * across, second) + _cross(first, d_second * across)
        d_length = d_first * (first * across).sum(axis=1) / length
        rows.append(d_bend / length**2.5 - 2.5 * bend * d_length / length**3.5)
    return np.array(rows), bend / length**2.5


def _normal(
    rows: NDArray[np.float64], residual: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """J^T J as `banded.solve` takes it, and J^T r, for a J of three cyclic diagonals."""
    behind, here, ahead = rows
    diagonals = np.array(
        [
            here**2 + np.roll(ahead, 1) ** 2 + np.roll(behind, -1) ** 2,
            here * ahead + np.roll(behind * here, -1),
            np.roll(behind * ahead, -1),
        ]
    )
    gradient = here * residual + np.roll(ahead * residual, 1) + np.roll(behind * residual, -1)
    return diagonals, gradient


def _differences(
    points: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    ahead, behind = np.roll(points, -1, axis=0), np.roll(points, 1, axis=0)
    first = (ahead - behind) / 2
    return first, ahead - 2 * points + behind, np.linalg.norm(first, axis=1)


def _cross(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])
