"""Fits and their intervals: statsmodels is the oracle."""

from __future__ import annotations

import numpy as np
import pytest
import statsmodels.api as sm
from scipy import stats
from statsmodels.base.model import GenericLikelihoodModel

from iort_analysis.statistics.fitting import Fit, Prior, fit
from iort_analysis.statistics.signals import lagged

TRUTH = np.array([2.0, -1.0])


def ours(design: np.ndarray, y: np.ndarray, **how: object) -> tuple[np.ndarray, np.ndarray, Fit]:
    found = fit(list(design.T), y, **how)
    assert found is not None
    return found.coefficients, np.sqrt(np.diag(found.covariance)), found


def drawn(seed: int, n: int = 2000) -> tuple[np.ndarray, np.random.Generator]:
    chance = np.random.default_rng(seed)
    return np.stack([chance.normal(size=n), np.ones(n)], axis=1), chance


def test_normal_errors_give_the_intervals_of_least_squares() -> None:
    ratios = []
    for seed in range(60):
        design, chance = drawn(seed)
        y = design @ TRUTH + chance.normal(size=len(design))
        coefficients, errors, found = ours(design, y)
        textbook = sm.OLS(y, design).fit()
        assert (np.abs(coefficients - textbook.params) < textbook.bse).all()
        assert found.sigma == pytest.approx(np.sqrt(textbook.scale), rel=0.1)
        ratios.append(errors / textbook.bse)
    # Tukey's weights cost 2.6 % of the error; 20 blocks tell it to a sixth, and a little too large.
    assert np.mean(ratios) == pytest.approx(1.04, abs=0.04)


def test_outliers_are_weighed_as_by_tukeys_robust_regression() -> None:
    design, chance = drawn(1)
    y = design @ TRUTH + chance.normal(size=len(design)) * np.where(chance.random(len(design)) < 0.2, 20, 1)
    coefficients, _, found = ours(design, y)
    robust = sm.RLM(y, design, M=sm.robust.norms.TukeyBiweight(4.685)).fit()
    assert (np.abs(coefficients - robust.params) < 0.05 * robust.bse).all()
    assert found.sigma == pytest.approx(robust.scale, rel=0.01)


def test_neighbours_that_are_alike_widen_the_interval_as_newey_and_west_say() -> None:
    found, wanted, apart = [], [], []
    for seed in range(60):
        chance = np.random.default_rng(seed)
        x, error = lagged(chance.normal(size=(2, 4000)), 20)
        design = np.stack([x, np.ones(4000)], axis=1)
        y = design @ TRUTH + error
        coefficients, errors, _ = ours(design, y)
        consistent = sm.OLS(y, design).fit(cov_type="HAC", cov_kwds={"maxlags": 150})
        found.append(errors)
        wanted.append(consistent.bse)
        apart.append(coefficients - TRUTH)
    assert np.mean(found, axis=0) == pytest.approx(np.mean(wanted, axis=0), rel=0.2)
    # Newey and West's are a little short, as their window cuts off; both are held against the truth.
    assert np.mean(found, axis=0) == pytest.approx(np.std(apart, axis=0), rel=0.2)


def test_a_prior_is_an_observation_of_its_weight() -> None:
    design, chance = drawn(3)
    design[:, 1] = design[:, 0] + 0.01 * chance.normal(size=len(design))
    y = design @ TRUTH + chance.normal(size=len(design))
    coefficients, errors, found = ours(design, y, priors={1: Prior(-0.5, 0.3)})
    # Theil and Goldberger's mixed estimation: least squares with a row for the prior.
    rows, values = np.vstack([design, [0, 1]]), np.append(y, -0.5)
    weights = np.append(np.full(len(y), found.sigma**-2), 0.3**-2)
    mixed = sm.WLS(values, rows, weights=weights).fit(cov_type="fixed scale")
    assert coefficients == pytest.approx(mixed.params, abs=0.05)
    assert errors == pytest.approx(mixed.bse, rel=0.3)


class Rounded(GenericLikelihoodModel):
    """Readings that stand for all that rounds to them, to one unit."""

    def loglike(self, params: np.ndarray) -> float:
        off, sigma = self.endog - self.exog @ params[:-1], np.exp(params[-1])
        chance = stats.norm.cdf((off + 0.5) / sigma) - stats.norm.cdf((off - 0.5) / sigma)
        return float(np.log(np.maximum(chance, 1e-300)).sum())


def test_rounded_readings_are_fitted_by_their_likelihood() -> None:
    design, chance = drawn(4, 4000)
    design[:, 0] *= 0.3
    y = np.round(design @ TRUTH + chance.normal(0, 0.25, len(design)))
    coefficients, errors, found = ours(design, y, resolution=1.0)
    likeliest = Rounded(y, design, extra_params_names=["log_sigma"]).fit(
        start_params=[*np.linalg.lstsq(design, y)[0], -1.0], disp=0
    )
    assert (np.abs(coefficients - likeliest.params[:2]) < 0.1 * likeliest.bse[:2]).all()
    assert found.sigma == pytest.approx(np.exp(likeliest.params[2]), rel=0.02)
    assert errors == pytest.approx(likeliest.bse[:2], rel=0.5)
