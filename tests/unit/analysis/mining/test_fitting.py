"""Fits whose intervals hold: with errors that neighbours share, readings that are rounded, and outliers."""

from __future__ import annotations

import math

import numpy as np
import pytest

from iort_analysis.statistics.fitting import Prior, fit, propagated
from iort_analysis.statistics.signals import lagged, resolution


def test_intervals_hold_although_neighbouring_errors_are_alike() -> None:
    chance, held, textbook = np.random.default_rng(3), 0, 0
    for _ in range(200):
        x = lagged(chance.normal(size=3000), 20)
        y = 2 * x + lagged(chance.normal(size=3000), 20)
        found = fit([x, np.ones(3000)], y)
        assert found is not None
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
        assert one is not None
        assert other is not None
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
    assert found is not None
    assert found.coefficients[0] == pytest.approx(3, abs=0.01)

    assert fit([x, 2 * x], noisy) is None
    told = fit([x, 2 * x], noisy, priors={1: Prior(1.0, 0.1)})
    assert told is not None
    assert told.coefficients == pytest.approx([1, 1], abs=0.02)
    assert told.of(1, "1").high - told.of(1, "1").low == pytest.approx(2 * 1.729 * 0.1, rel=0.05)


def test_a_function_of_independent_fits_has_the_errors_of_all() -> None:
    ratio = propagated(
        lambda c: c[0] / c[1],
        (np.array([4.0]), np.array([[0.04]])),
        (np.array([2.0]), np.array([[0.01]])),
        unit="1",
    )
    assert ratio.value == 2
    assert ratio.high - ratio.value == pytest.approx(1.729 * 2 * math.hypot(0.05, 0.05), rel=1e-3)
