"""Clusters of windows: scikit-learn is the oracle."""

from __future__ import annotations

import numpy as np
import pytest
from sklearn.cluster import KMeans
from sklearn.metrics import adjusted_rand_score, silhouette_score
from sklearn.preprocessing import RobustScaler
from threadpoolctl import threadpool_limits

from iort_analysis.statistics.clusters import cluster, scaled


def blobs(seed: int, wide: float) -> np.ndarray:
    chance = np.random.default_rng(seed)
    middles = chance.uniform(-4, 4, (4, 3))
    return np.concatenate([middle + chance.normal(0, wide, (100, 3)) for middle in middles])


@pytest.mark.parametrize("seed", range(3))
def test_the_clusters_that_are_best_apart(seed: int) -> None:
    points = blobs(seed, 0.5)
    # Threads that wait for each other take far longer than one.
    with threadpool_limits(1):
        tried = [KMeans(k, n_init=10, random_state=0).fit(points).labels_ for k in range(2, 7)]
    scores = [silhouette_score(points, labels) for labels in tried]
    found = cluster(points, 6)
    # Ours starts three times, not ten.
    assert found.silhouette == pytest.approx(max(scores), abs=0.01)
    assert found.silhouette == pytest.approx(silhouette_score(points, found.labels), abs=1e-9)
    assert adjusted_rand_score(tried[int(np.argmax(scores))], found.labels) > 0.95


def test_columns_are_scaled_by_their_middle_and_spread() -> None:
    points = blobs(1, 2.0)
    wanted = RobustScaler(quantile_range=(10, 90)).fit_transform(points)
    np.testing.assert_allclose(scaled(points), np.clip(wanted, -3, 3))
