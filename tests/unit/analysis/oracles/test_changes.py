"""Changes within a drive: ruptures, statsmodels and SciPy are the oracles."""

from __future__ import annotations

import numpy as np
import pytest
import ruptures
from statsmodels.stats.diagnostic import breaks_cusumolsresid

from iort_analysis.mining.changes import changed


@pytest.mark.parametrize("seed", range(10))
@pytest.mark.parametrize("at", [30, 130])
def test_a_change_is_where_the_best_two_pieces_meet(at: int, seed: int) -> None:
    values = np.random.default_rng(seed).normal(size=200)
    values[at:] += 1.5
    found = changed(values, "V")
    assert found is not None
    best, _ = ruptures.Dynp(model="l2", min_size=20, jump=1).fit(values).predict(n_bkps=1)
    assert found.place == best
    assert found.effect.value == pytest.approx(values[best:].mean() - values[:best].mean())


def test_the_chance_of_a_change_is_that_of_the_cusum_test() -> None:
    found, wanted = [], []
    for seed in range(300):
        values = np.random.default_rng(seed).normal(size=400)
        one = changed(values, "V")
        assert one is not None
        found.append(one.p)
        wanted.append(breaks_cusumolsresid(values - values.mean())[1])
    # Ours allows for neighbours that are alike, so that its deviation is another one; on the whole it agrees.
    assert np.corrcoef(found, wanted)[0, 1] > 0.9
    assert np.mean(np.array(found) < 0.1) == pytest.approx(np.mean(np.array(wanted) < 0.1), abs=0.05)
