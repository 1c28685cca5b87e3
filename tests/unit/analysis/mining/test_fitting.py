"""Fits whose intervals hold: with errors that neighbours share, readings that are rounded, and outliers."""

from __future__ import annotations

import math
from collections import defaultdict

import numpy as np
import pytest

from bench.proof.fleet import ANY_CARS, drive_of, simulated
from bench.proof.judging import INDICATORS, SPANNING, TRUTHS
from iort_agent.sources.sim import ALL
from iort_analysis.process import MINERS, analyse
from iort_analysis.statistics.distributions import mean_of
from iort_analysis.statistics.fitting import Part, Prior, fit, propagated
from iort_analysis.statistics.signals import lagged, quantum, resolution
from iort_contract.catalog.derived import F1TENTH


def test_intervals_hold_although_neighbouring_errors_are_alike() -> None:
    chance, held, textbook = np.random.default_rng(3), 0, 0
    for _ in range(200):
        x = lagged(chance.normal(size=3000), 20)
        y = 2 * x + lagged(chance.normal(size=3000), 20)
        found = fit([x, np.ones(3000)], y)
        slope = found.of(0, "1")
        held += slope.low < 2 < slope.high
        (value, _), covariance = np.polyfit(x, y, 1, cov=True)
        textbook += abs(value - 2) < 1.645 * math.sqrt(covariance[0, 0])

    assert 170 <= held <= 190
    assert textbook < 80


def test_a_reading_stands_for_all_that_rounds_to_it() -> None:
    # The load moves the value by less than a step, so that the error of rounding follows the load.
    chance, plain, aware = np.random.default_rng(5), 0, 0
    for _ in range(60):
        load = lagged(chance.normal(size=4000), 50) * 10
        value = chance.uniform(11, 12) - 0.03 * load + chance.normal(0, 0.02, 4000)
        columns, rounded = [np.ones(4000), -load], value.round(1)
        one, other = fit(columns, rounded), fit(columns, rounded, resolution=resolution(rounded))
        plain += one.of(1, "ohm").low < 0.03 < one.of(1, "ohm").high
        aware += other.of(1, "ohm").low < 0.03 < other.of(1, "ohm").high

    assert aware >= 49
    assert plain < 30


def test_outliers_weigh_nothing_and_a_prior_decides_what_the_data_does_not() -> None:
    x = np.linspace(-1, 1, 500)
    y = 3 * x
    y[::25] += 50
    noisy = y + np.random.default_rng(1).normal(0, 0.01, 500)
    found = fit([x], noisy)
    assert found.coefficients[0] == pytest.approx(3, abs=0.01)

    assert fit([x, 2 * x], noisy) is None
    told = fit([x, 2 * x], noisy, priors={1: Prior(1.0, 0.1)})
    assert told.coefficients == pytest.approx([1, 1], abs=0.02)
    # A prior's deviation is known, unlike one that the spread of twenty blocks tells.
    assert told.of(1, "1").high - told.of(1, "1").low == pytest.approx(2 * 1.645 * 0.1, rel=0.002)
    assert found.of(0, "1").high - found.of(0, "1").low == pytest.approx(
        2 * 1.729 * math.sqrt(found.covariance[0, 0]), rel=0.001
    )


@pytest.mark.parametrize(("given", "t"), [(0.0, 1.686), (0.01, 1.645), (0.0025, 1.668)])
def test_a_function_of_independent_fits_has_the_errors_of_all(given: float, t: float) -> None:
    # Two variances that 19 degrees of freedom tell each; one of them may be given in part.
    nothing = np.zeros((1, 1))
    ratio = propagated(
        lambda c: c[0] / c[1],
        Part(np.array([4.0]), np.array([[0.04]]), np.array([[4 * given]])),
        Part(np.array([2.0]), np.array([[0.01]]), nothing + given),
        unit="1",
    )
    assert ratio.value == 2
    assert ratio.high - ratio.value == pytest.approx(t * 2 * math.hypot(0.05, 0.05), rel=2e-3)


def test_values_between_two_readings_share_the_error_of_the_one_between_them() -> None:
    chance, widths, plain, apart = np.random.default_rng(7), [], [], []
    for _ in range(100):
        # Ways between positions with noise: an error of one is in both ways beside it.
        way = chance.uniform(0.5, 1.5, 600)
        seen = 3 * way + np.diff(chance.normal(0, 0.1, 601))
        found, other = fit([way], seen, shared=True), fit([way], seen)
        widths.append(found.covariance[0, 0])
        plain.append(other.covariance[0, 0])
        apart.append(found.coefficients[0] - 3)

    assert np.sqrt(np.mean(widths)) == pytest.approx(np.std(apart), rel=0.2)
    assert np.sqrt(np.mean(plain)) > 1.1 * np.std(apart)


def test_another_model_of_the_same_samples_counts_if_it_differs_beyond_chance() -> None:
    chance = np.random.default_rng(2)
    x = chance.uniform(0, 2, 2000)
    noise = lagged(chance.normal(size=2000), 10) * 0.3
    for bend, holds in ((0.0, False), (0.2, True)):
        y = 2 * x + bend * x**2 + noise
        line, curve = fit([x], y), fit([x, x**2], y)
        before, after = line.of(0, "1"), line.beside([curve], [0]).of(0, "1")
        # At the origin the slope is 2, on the whole it is more: the interval holds both.
        assert (after.high - after.low > before.high - before.low) is holds
        assert (after.low < 2 < after.high) is True
        assert (before.low < 2 < before.high) is not holds


@pytest.mark.parametrize("value", [6.0, 11.6, 5.63999])
def test_an_interval_is_never_narrower_than_the_step_in_which_values_are_reported(value: float) -> None:
    step = {6.0: 1.0, 11.6: 0.1, 5.63999: 1e-5}[value]
    constant = np.full(400, value)
    assert quantum(constant) == pytest.approx(step)
    found = fit([np.ones(400)], constant)
    of_fit = found.of(0, "s")
    of_mean = mean_of(constant)
    for low, high in ((of_fit.low, of_fit.high), of_mean[1:]):
        assert high - low == pytest.approx(2 * 1.645 * step / math.sqrt(12), rel=0.01)
    # Values with more places than a sensor sends are 32-bit floats.
    assert 0 < quantum(np.full(5, math.pi)) < 1e-6


# The intervals of a car's parameters, on a few cars of any lab: `make bench ONLY=analysis` has more.

# Apart from those of the proof.
_CARS, _SECONDS = range(3000, 3010), 240.0
# Without the motor's flux linkage only.
_RATIOS = {"acceleration_per_a_mps2", "friction_per_mass_mps2"}
_MINERS = {name: MINERS[name] for name in ("battery", "motor", "drivetrain", "thermal")}


def test_intervals_are_neither_too_narrow_nor_too_wide() -> None:
    off = defaultdict(list)
    for car in _CARS:
        spec = drive_of(car, 0, seconds=_SECONDS, cars=ANY_CARS)
        streams, truth = simulated(spec, None)
        truth |= {"seconds": _SECONDS, "motor_sensor": float(spec.fields == ALL)}
        known = {"mass_kg": spec.vehicle.mass_kg, "pole_pairs": float(spec.vehicle.pole_pairs)}
        for name, one in analyse(spec.key, streams, F1TENTH, known, miners=_MINERS).mined.estimates.items():
            if name in TRUTHS:
                off[name].append((one.value - TRUTHS[name](truth)) / (one.high - one.low) * 2)

    # In half widths; of errors that are as the intervals say, 0.6.
    errors = {name: math.sqrt(sum(one * one for one in some) / len(some)) for name, some in off.items()}
    assert errors.keys() == TRUTHS.keys() - INDICATORS - SPANNING - _RATIOS
    assert {name: error for name, error in errors.items() if not 0.15 < error < 1.25} == {}
    every = [one for some in off.values() for one in some]
    assert 0.8 < sum(abs(one) < 1 for one in every) / len(every) < 0.97
