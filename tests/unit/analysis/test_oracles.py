"""Changes within a drive: ruptures, statsmodels and SciPy are the oracles."""

from __future__ import annotations

import math

import numpy as np
import pytest
import ruptures
import statsmodels.api as sm
from hypothesis import given
from hypothesis import strategies as st
from scipy import signal, stats
from scipy.interpolate import BSpline
from statsmodels.base.model import GenericLikelihoodModel
from statsmodels.stats.diagnostic import breaks_cusumolsresid
from statsmodels.stats.meta_analysis import combine_effects
from statsmodels.stats.multitest import multipletests
from statsmodels.stats.weightstats import DescrStatsW

from iort_agent.sources.sim.vehicle import Vehicle, VehicleConfig
from iort_analysis.baselines import US_PER_DAY, combined, trend
from iort_analysis.evaluation import false_discovery_rates
from iort_analysis.mining import drivetrain
from iort_analysis.mining.changes import changed
from iort_analysis.statistics.distributions import between, mean_of, quantile, sides, tail
from iort_analysis.statistics.fitting import Fit, Prior, fit
from iort_analysis.statistics.signals import lagged, smooth_basis
from iort_contract.messages.analysis import Estimate
from tests.unit.analysis.simulated import driven


@pytest.mark.parametrize("seed", range(10))
@pytest.mark.parametrize("at", [30, 130])
def test_a_change_is_where_the_best_two_pieces_meet(at: int, seed: int) -> None:
    values = np.random.default_rng(seed).normal(size=200)
    values[at:] += 1.5
    found = changed(values, "V")
    best, _ = ruptures.Dynp(model="l2", min_size=20, jump=1).fit(values).predict(n_bkps=1)
    assert found.place == best
    assert found.effect.value == pytest.approx(values[best:].mean() - values[:best].mean())


def test_the_chance_of_a_change_is_that_of_the_cusum_test() -> None:
    found, wanted = [], []
    for seed in range(300):
        values = np.random.default_rng(seed).normal(size=400)
        one = changed(values, "V")
        found.append(one.p)
        wanted.append(breaks_cusumolsresid(values - values.mean())[1])
    # Ours allows for neighbours that are alike, so that its deviation is another one; on the whole it agrees.
    assert np.corrcoef(found, wanted)[0, 1] > 0.9
    assert np.mean(np.array(found) < 0.1) == pytest.approx(np.mean(np.array(wanted) < 0.1), abs=0.05)


# Distributions, intervals and filters: SciPy and statsmodels are the oracles.


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


# What moves the car: PySINDy is the oracle, which finds the equation in the simulator's true states.

SECONDS, STEP_S = 240, 0.02


def test_the_equation_of_motion() -> None:
    car, states = Vehicle(VehicleConfig(), 1), []
    for _ in range(SECONDS * 50):
        before = car.speed_mps
        car.step(STEP_S)
        states.append(
            (before, max(car.motor_a, 0.0), min(car.motor_a, 0.0), car.speed_mps - before, car.slips)
        )
    speed, drives, brakes, gained, slips = np.array(states).T
    rolls = (speed > 0.5) & (slips == 0)
    # It takes seconds to load, in each of the workers that collect this file.
    import pysindy

    model = pysindy.SINDy(
        optimizer=pysindy.STLSQ(threshold=1e-3, alpha=0.0),
        feature_library=pysindy.PolynomialLibrary(degree=2, include_interaction=False),
    )
    model.fit(
        speed[rolls][:, None],
        t=STEP_S,
        x_dot=gained[rolls][:, None] / STEP_S,
        u=np.stack([drives, brakes], axis=1)[rolls],
    )
    # Of all squares and lines it keeps those of Newton's law: force, friction and the air's drag.
    found = dict(zip(model.get_feature_names(), model.coefficients()[0], strict=True))
    assert {name for name, value in found.items() if value} == {"1", "x0^2", "u0", "u1"}

    mined = {name: one.value for name, one in drivetrain.mine(driven(SECONDS).drive).estimates.items()}
    kg, efficiency = mined["effective_mass_kg"], mined["drivetrain_efficiency"]
    assert mined["motor_force_n_per_a"] * efficiency / kg == pytest.approx(found["u0"], rel=0.005)
    assert mined["motor_force_n_per_a"] / efficiency / kg == pytest.approx(found["u1"], rel=0.005)
    assert -mined["friction_n"] / kg == pytest.approx(found["1"], rel=0.04)
    assert -mined["drag_n_s2_per_m2"] / kg == pytest.approx(found["x0^2"], rel=0.05)


# Corrections for many tests, means over drives and trends: statsmodels and SciPy are the oracles.


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


# Fits and their intervals: statsmodels is the oracle.

TRUTH = np.array([2.0, -1.0])


def ours(design: np.ndarray, y: np.ndarray, **how: object) -> tuple[np.ndarray, np.ndarray, Fit]:
    found = fit(list(design.T), y, **how)
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
