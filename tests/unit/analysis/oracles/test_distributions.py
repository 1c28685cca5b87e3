"""Distributions, intervals and filters: SciPy and statsmodels are the oracles."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy import signal, stats
from scipy.interpolate import BSpline
from statsmodels.stats.proportion import proportion_confint
from statsmodels.stats.weightstats import DescrStatsW

from iort_analysis.statistics.distributions import between, mean_of, quantile, share_of, tail
from iort_analysis.statistics.signals import lagged, smooth_basis


@pytest.mark.parametrize("freedom", [1, 2, 4.5, 30, 1e4, math.inf])
@pytest.mark.parametrize("p", [0.5001, 0.6, 0.95, 0.9999])
def test_students_t(p: float, freedom: float) -> None:
    t = stats.t.ppf(p, freedom)
    assert quantile(p, freedom) == pytest.approx(t, rel=1e-8, abs=1e-8)
    assert [tail(t, freedom), tail(-t, freedom)] == pytest.approx([1 - p, p], rel=1e-8)


@pytest.mark.parametrize("n", [2, 5, 11, 100])
def test_the_interval_of_a_mean(n: int) -> None:
    values = np.random.default_rng(n).normal(3, 2, n)
    assert mean_of(values)[1:] == pytest.approx(DescrStatsW(values).tconfint_mean(alpha=0.1))


@pytest.mark.parametrize(("hits", "n"), [(0, 5), (1, 9), (30, 60), (7, 7), (2.5, 11)])
def test_the_interval_of_a_share(hits: float, n: float) -> None:
    assert share_of(hits, n)[1:] == pytest.approx(proportion_confint(hits, n, alpha=0.1, method="wilson"))


@pytest.mark.parametrize("width", [0.2, 1.0, 4.0])
def test_the_slopes_of_the_chance_of_an_interval(width: float) -> None:
    low = np.linspace(-4, 4 - width, 41)
    high = low + width
    chance = stats.norm.cdf(high) - stats.norm.cdf(low)
    slope = (stats.norm.pdf(low) - stats.norm.pdf(high)) / chance
    spread = (low * stats.norm.pdf(low) - high * stats.norm.pdf(high)) / chance
    np.testing.assert_allclose(between(low, high)[0], slope, rtol=0.01, atol=1e-4)
    np.testing.assert_allclose(between(low, high)[2], spread, rtol=0.01, atol=1e-3)


@pytest.mark.parametrize("steps", [0.7, 7.5, 300.0])
def test_a_first_order_lag(steps: float) -> None:
    values, keep = np.random.default_rng(0).normal(size=(2, 999)), math.exp(-1 / steps)
    np.testing.assert_allclose(
        lagged(values, steps), signal.lfilter([1 - keep], [1, -keep], values), atol=1e-12
    )


def test_the_basis_of_smooth_curves() -> None:
    values, pieces = np.linspace(2, 5, 200), 4
    knots = 2 + 3 / pieces * np.arange(-2, pieces + 3)
    wanted = BSpline.design_matrix(values, knots, 2, extrapolate=False).toarray()
    np.testing.assert_allclose(np.stack(smooth_basis(values, pieces), axis=1), wanted, atol=1e-9)
