"""Clusters of points: k-means with the number of clusters by silhouette."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
# The centres are of this many points at most. The silhouette needs every distance, so it is of fewer.
_MOST_FITTED, _MOST_COMPARED = 1500, 600
_ROUNDS = 60
_STARTS = 3


class Clusters(NamedTuple):
    """The cluster of every point, and how well apart they are: from -1 to 1."""

    labels: NDArray[np.intp]
    silhouette: float


def scaled(features: Floats) -> Floats:
    """Columns by their median and their spread from the 10th to the 90th percentile; outliers are cut off."""
    low, middle, high = np.percentile(features, [10, 50, 90], axis=0)
    spread = high - low
    wide: Floats = (features - middle) / np.where(spread > 0, spread, 1.0)
    return np.clip(wide, -3, 3)


def cluster(points: Floats, most: int) -> Clusters:
    """The clusters of points, 2 to ``most``, that are best apart. The same points give the same clusters."""
    chance = np.random.default_rng(0)
    fitted = chance.permutation(points)[:_MOST_FITTED]
    compared = fitted[:_MOST_COMPARED]
    apart = np.sqrt(_squares(compared, compared))
    centres, best = fitted[:1], -1.0
    for k in range(2, min(most, len(points)) + 1):
        found = min((_k_means(fitted, k, chance) for _ in range(_STARTS)), key=lambda tried: tried[1])[0]
        silhouette = _silhouette(apart, _squares(compared, found).argmin(axis=1))
        if silhouette > best:
            centres, best = found, silhouette
    return Clusters(_squares(points, centres).argmin(axis=1), best)


def _k_means(points: Floats, k: int, chance: np.random.Generator) -> tuple[Floats, float]:
    """Lloyd's rounds from far-apart points (k-means++): centres, and the sum of squared distances."""
    centres = points[chance.integers(len(points))][None]
    while len(centres) < k:
        nearest = _squares(points, centres).min(axis=1)
        total = nearest.sum()
        if total == 0:
            break
        centres = np.vstack([centres, points[chance.choice(len(points), p=nearest / total)]])
    labels = np.zeros(len(points), dtype=np.intp)
    for _ in range(_ROUNDS):
        squares = _squares(points, centres)
        found = squares.argmin(axis=1)
        if (found == labels).all():
            break
        labels = found
        filled = np.unique(labels)
        labels = np.searchsorted(filled, labels)
        members = labels == np.arange(len(filled))[:, None]
        centres = members @ points / members.sum(axis=1, keepdims=True)
    return centres, float(_squares(points, centres).min(axis=1).sum())


def _squares(points: Floats, centres: Floats) -> Floats:
    squares: Floats = (points**2).sum(axis=1)[:, None] - 2 * points @ centres.T + (centres**2).sum(axis=1)
    return np.maximum(squares, 0.0)


def _silhouette(apart: Floats, labels: NDArray[np.intp]) -> float:
    """The mean of (b - a) / max(a, b): a is the mean distance in the own cluster, b to the nearest other."""
    filled, counts = np.unique(labels, return_counts=True)
    if len(filled) < 2:
        return -1.0
    own = np.searchsorted(filled, labels)
    sums = apart @ (own[:, None] == np.arange(len(filled)))
    rows = np.arange(len(labels))
    alone = counts[own] == 1
    a = sums[rows, own] / np.maximum(counts[own] - 1, 1)
    means = sums / counts
    means[rows, own] = np.inf
    b = means.min(axis=1)
    widest = np.maximum(np.maximum(a, b), 1e-12)
    return float(np.where(alone, 0.0, (b - a) / widest).mean())
