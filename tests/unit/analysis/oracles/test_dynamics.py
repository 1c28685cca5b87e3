"""What moves the car: PySINDy is the oracle, which finds the equation in the simulator's true states."""

from __future__ import annotations

import numpy as np
import pysindy
import pytest

from iort_agent.sources.sim.vehicle import Vehicle, VehicleConfig
from iort_analysis.mining import drivetrain
from tests.unit.analysis.drives import driven

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
