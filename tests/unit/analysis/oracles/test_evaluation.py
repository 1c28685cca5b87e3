"""Corrections for many tests, means over drives and trends: statsmodels and SciPy are the oracles."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats
from statsmodels.stats.meta_analysis import combine_effects
from statsmodels.stats.multitest import multipletests

from iort_analysis.baselines import US_PER_DAY, combined, trend
from iort_analysis.evaluation import false_discovery_rates
from iort_analysis.statistics.distributions import sides
from iort_contract.messages.analysis import Estimate


@given(st.lists(st.floats(0, 1), min_size=1, max_size=40))
def test_rates_of_false_discoveries(p_values: list[float]) -> None:
    found = false_discovery_rates(p_values)
    assert found == pytest.approx(multipletests(p_values, method="fdr_by")[1])
    # Benjamini and Hochberg's, for tests that have nothing to do with each other, find all of these and more.
    assert (multipletests(p_values, method="fdr_bh")[1] <= np.array(found) + 1e-12).all()


@pytest.mark.parametrize("apart", [0.0, 0.5, 5.0])
@pytest.mark.parametrize("n", [2, 3, 12])
def test_a_mean_over_drives(n: int, apart: float) -> None:
    chance = np.random.default_rng(n)
    errors = chance.uniform(0.1, 1, n)
    values = chance.normal(10, np.hypot(errors, apart))
    found = combined(
        [Estimate(v, v - sides() * e, v + sides() * e, "V") for v, e in zip(values, errors, strict=True)]
    )
    with np.errstate(invalid="ignore"):
        meta = combine_effects(values, errors**2, method_re="chi2", use_t=True)
    # Drives differ by no less than nothing, where statsmodels' estimate falls below 0.
    mean, hartung_knapp, normal = (
        (meta.mean_effect_re, meta.sd_eff_w_re_hksj, meta.sd_eff_w_re)
        if meta.tau2 > 0
        else (meta.mean_effect_fe, meta.sd_eff_w_fe_hksj, meta.sd_eff_w_fe)
    )
    assert found.value == pytest.approx(mean)
    # Ours is never narrower than by the drives' own errors.
    assert found.high - found.value == pytest.approx(max(sides(n - 1) * hartung_knapp, sides() * normal))


@pytest.mark.parametrize("slope", [0.0, 0.4, -2.0])
def test_a_trend(slope: float) -> None:
    chance = np.random.default_rng(2)
    days = np.cumsum(chance.integers(1, 4, 12))
    values = slope * days + chance.normal(size=12)
    found = trend([int(day) * US_PER_DAY for day in days], values.tolist(), "V")
    sen = stats.theilslopes(values, days, alpha=0.9)
    assert found.per_day.value == pytest.approx(sen.slope)
    assert found.per_day.unit == "V/d"
    # The interval's ends are slopes between two drives. Ours rounds outwards, by one place at most.
    slopes = np.sort(
        [(values[j] - values[i]) / (days[j] - days[i]) for i in range(12) for j in range(i + 1, 12)]
    )
    for end, theirs, way in ((found.per_day.low, sen.low_slope, -1), (found.per_day.high, sen.high_slope, 1)):
        assert 0 <= way * (np.searchsorted(slopes, end) - np.searchsorted(slopes, theirs)) <= 1
    # Kendall's exact test counts the orders; ours takes the normal distribution for their number.
    exact = stats.kendalltau(days, values, method="exact").pvalue
    assert min(1.0, 2 * min(found.p_up, found.p_down)) == pytest.approx(exact, abs=0.02)
