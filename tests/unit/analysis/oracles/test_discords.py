"""The matrix profile: stumpy's MASS is the oracle."""

from __future__ import annotations

import numpy as np
import pytest

from iort_analysis.mining.anomalies.profile import matrix_profile

# numba compiles stumpy for seconds.
pytestmark = pytest.mark.slow


@pytest.mark.parametrize(("seed", "m"), [(0, 8), (1, 13), (2, 20)])
def test_the_profile_and_its_discord(seed: int, m: int) -> None:
    import stumpy

    chance = np.random.default_rng(seed)
    series = np.sin(np.arange(300) / 4) + 0.2 * chance.normal(size=300)
    series[140:150] += chance.normal(size=10)
    places = np.arange(len(series) - m + 1)
    wanted = np.empty(len(places))
    for place in places:
        far = stumpy.mass(series[place : place + m], series)
        far[np.abs(places - place) <= m // 2] = np.inf
        wanted[place] = far.min()
    found = matrix_profile(series, m)
    np.testing.assert_allclose(found, wanted, atol=1e-6)
    assert found.argmax() == wanted.argmax()
