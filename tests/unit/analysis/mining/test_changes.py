"""Changes within a drive, and stretches that are like no other, of known truths."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from iort_analysis.drives.building import build
from iort_analysis.mining import anomalies
from iort_analysis.mining.changes import changed


def alike(rho: float, n: int, seed: int) -> np.ndarray:
    """Noise whose neighbours are alike."""
    made = np.random.default_rng(seed).normal(size=n)
    for i in range(1, n):
        made[i] = rho * made[i - 1] + np.sqrt(1 - rho**2) * made[i]
    return made


@pytest.mark.parametrize("rho", [0.0, 0.5])
def test_noise_changes_no_more_often_than_by_chance(rho: float) -> None:
    p_values = [found.p for seed in range(300) if (found := changed(alike(rho, 120, seed), "V")) is not None]
    assert len(p_values) == 300
    assert np.mean(np.array(p_values) < 0.1) < 0.15
    assert min(p_values) > 1e-5


def test_a_change_is_found_with_its_place_and_size() -> None:
    held = 0
    for seed in range(100):
        values = alike(0.3, 120, seed)
        values[80:] += 3.0
        found = changed(values, "V")
        assert found.p < 1e-3
        assert abs(found.place - 80) < 8
        held += found.effect.low < 3.0 < found.effect.high
    assert held >= 80


@given(st.floats(0.01, 100), st.floats(-100, 100))
def test_a_change_follows_the_scale(scale: float, shift: float) -> None:
    values = alike(0.3, 60, 1)
    one, other = changed(values, "V"), changed(scale * values + shift, "V")
    assert other.place == one.place
    assert other.p == pytest.approx(one.p, rel=1e-6)
    assert other.effect.value == pytest.approx(scale * one.effect.value, rel=1e-6)


def test_what_is_constant_or_short_has_no_change() -> None:
    assert changed(np.ones(100), "V") is None
    assert changed(np.arange(10.0), "V") is None


def test_friction_that_begins_on_the_way_is_found_at_its_time() -> None:
    from bench.proof.fleet import drive_of, simulated
    from iort_agent.sources.sim.faults import FaultConfig

    spec = drive_of(300, 1, [FaultConfig("added_friction", "strong", 180.0)], seconds=300.0)
    found = anomalies.mine(build(spec.key, simulated(spec, None).streams)).events
    (event,) = [one for one in found if one.kind == "friction_added"]
    assert (event.start_us - spec.key.start_us) / 1e6 == pytest.approx(180, abs=15)
    assert event.p < 1e-4
