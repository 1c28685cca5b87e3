"""Heat: motor and controller as two bodies, warmed by the current's square and cooled by the air.

    time constant * dT/dt = rest - T + rise * current^2 * copper(T) + share * (other T) - wind' * (T - air)

``rise`` is how much warmer the body gets for each A^2 that flows for long, ``rest`` where it settles without
load, both in the drive's mean wind; wind' is what the speed adds to it at the moment. A steady load cannot
tell a body's warmth from the air's; the laps' ups and downs do, and the bend of the curve gives the time
constant. Heat in watts needs the motor's resistance: a thermal resistance is for the watts lost in windings
and MOSFETs together, since no field tells their shares. Where only the controller's temperature is there,
what the motor gives to it slowly is a term with a prior.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from iort_analysis import NoResultError
from iort_analysis.drives.drive import Drive
from iort_analysis.mining.motor import COPPER_PER_K, REFERENCE_DEGC, fit_motor
from iort_analysis.results import Mined, attempt, miner
from iort_analysis.statistics.fitting import Fit, Part, Prior, fit, propagated
from iort_analysis.statistics.signals import Array, binned, bridged, lagged
from iort_contract.messages.analysis import Estimate

_STEP_S, _MEAN, _LEAST_S = 0.25, 8, 180.0
_LEAST_A2 = 1.0
# The time constants that are tried, and the rounds that find the one between them.
_TIMES_S = tuple(float(time) for time in np.geomspace(40, 3000, 10))
_ROUNDS = 5
# The share of a body's cooling that goes into the other one.
_SHARE = Prior(0.03, 0.03)
# A motor without a sensor warms in so long; the controller's rise has so much of it, as a share.
_MOTOR_S, _MOTOR_SHARE = 400.0, Prior(0.2, 0.15)
# The VESC begins to limit the current from these temperatures on, by default.
LIMITS_DEGC = {"motor": 85.0, "controller": 85.0}
_CONTROLLERS = ("temp_fet", "temperature_pcb")
# The load of the last minutes is the present one.
_PRESENT_S = 120.0
_SENSOR_K = 0.1
_WHAT = ("rise_k_per_a2", "thermal_resistance_k_per_w", "final_degc", "time_to_limit_s")


class _Load(NamedTuple):
    """What warms and cools the bodies: the current's square, the wind, and the copper's temperature."""

    squares: Array
    wind: Array
    copper: Array | None

    @property
    def present_a2(self) -> float:
        """The mean square of the current in the drive's last minutes."""
        return float(self.squares[-round(_PRESENT_S / _STEP_S) :].mean())

    @property
    def heat(self) -> Array:
        """The current's square as copper at 25 degC would have to carry it for the same heat."""
        if self.copper is None:
            return self.squares
        return self.squares * (1 + COPPER_PER_K * (bridged(self.copper) - REFERENCE_DEGC))


class Body(NamedTuple):
    """A body under its load.

    The fit's coefficients are rest, start, rise and share, and last what the logarithm of ``time_s`` is off.
    ``degc`` are its temperatures, ``other_degc`` the other body's mean one; NaN if it is not known.
    """

    load: _Load
    fit: Fit
    time_s: float
    degc: Array
    other_degc: float

    @property
    def rise(self) -> Estimate:
        """The warming for each A^2 of the mean square of the current, of copper at 25 degC."""
        return self.fit.estimate(self._rises, "K/A2")

    def resistance(self, ohm: Part) -> Estimate:
        """The thermal resistance for the losses in a motor of so much resistance."""
        return propagated(lambda c: self._rises @ c[:-1] / (1.5 * c[-1]), self.fit.part(), ohm, unit="K/W")

    def final(self, other_degc: float | None = None) -> Estimate:
        """The temperature at which it settles if the present load goes on, and the other body settles too."""
        squares_a2 = self.load.present_a2
        grows = 0.0 if self.load.copper is None else COPPER_PER_K
        above = 0.0 if other_degc is None or self.alone else other_degc - self.other_degc

        def settled(c: Array) -> Any:
            rise = self._rises @ c * squares_a2
            warm = 0.0 if self.alone else c[3] * above
            return (c[0] + warm + rise * (1 - grows * REFERENCE_DEGC)) / (1 - rise * grows)

        found = propagated(settled, self.fit.part(), unit="degC")
        # Nobody knows a temperature better than the sensor does.
        return found._replace(low=found.low - _SENSOR_K / 2, high=found.high + _SENSOR_K / 2)

    def time_to(self, limit_degc: float, final: Estimate) -> Estimate | str:
        """The time until a temperature is reached on the way to the final one; or why it is not."""
        now = float(self.degc[-1])
        if now >= limit_degc:
            return f"{now:.0f} degC is at the limit already"
        if final.low <= limit_degc:
            return f"at this load it settles at {final.value:.0f} degC, below or near {limit_degc:g} degC"
        times = sorted(
            -self.time_s * math.log((end - limit_degc) / (end - now))
            for end in (final.low, final.value, final.high)
        )
        return Estimate(times[1], times[0], times[2], "s")

    @property
    def alone(self) -> bool:
        """Whether the other body's temperature is not known."""
        return math.isnan(self.other_degc)

    @property
    def _rises(self) -> Array:
        # What comes by way of a motor without a sensor is in the same unit.
        weights = np.zeros(len(self.fit.coefficients))
        weights[2], weights[3] = 1, self.alone
        return weights


@miner(*(f"{name}_{what}" for name in LIMITS_DEGC for what in _WHAT))
def mine(drive: Drive) -> Mined:
    """How motor and controller warm up, and where that ends."""
    needs = f"needs current_motor, speed and {_LEAST_S:g} s"
    current, speed = drive.motor("current_motor", "speed", reason=needs)
    seconds = drive.seconds
    if seconds[-1] < _LEAST_S:
        raise NoResultError(needs)
    squares = bridged(binned(seconds, current**2, _STEP_S))
    wind = bridged(binned(seconds, np.abs(speed), _STEP_S))
    motor = _binned(drive, "temp_motor")
    controller = next((c for name in _CONTROLLERS if (c := _binned(drive, name)) is not None), None)
    load = _Load(squares, wind - wind.mean(), motor)
    found = {
        "motor": attempt(_fit_body, load, motor, controller),
        # The MOSFETs are no copper.
        "controller": attempt(_fit_body, load._replace(copper=None), controller, motor),
    }
    resistance = attempt(fit_motor, drive)
    if not isinstance(resistance, str) and resistance.unknown_ohm:
        resistance = resistance.unknown_ohm
    estimates: dict[str, Estimate] = {}
    missing: dict[str, str] = {}
    finals = _finals(found)
    for name, body in found.items():
        if isinstance(body, str):
            missing |= {f"{name}_{what}": body for what in _WHAT}
            continue
        said: dict[str, Estimate | str] = {
            "rise_k_per_a2": body.rise,
            "thermal_resistance_k_per_w": resistance
            if isinstance(resistance, str)
            else body.resistance(resistance.fit.part(1)),
            "final_degc": finals[name],
            "time_to_limit_s": body.time_to(LIMITS_DEGC[name], finals[name]),
        }
        estimates |= {f"{name}_{what}": one for what, one in said.items() if isinstance(one, Estimate)}
        missing |= {f"{name}_{what}": one for what, one in said.items() if isinstance(one, str)}
    return Mined(estimates, missing)


def _finals(bodies: dict[str, Body | str]) -> dict[str, Estimate]:
    """Where the bodies settle, each beside the other one."""
    known = {name: body for name, body in bodies.items() if isinstance(body, Body)}
    finals = {name: body.final() for name, body in known.items()}
    for _ in range(_ROUNDS):
        for name, body in known.items():
            beside = next((final.value for other, final in finals.items() if other != name), None)
            finals[name] = body.final(beside)
    return finals


def _fit_body(load: _Load, degc: Array | None, other: Array | None) -> Body:
    """Fit one body with the best time constant, whose uncertainty is in the covariance; raises
    `NoResultError`."""
    if degc is None:
        raise NoResultError("the drive has no such temperature")
    if float(np.std(load.squares)) < _LEAST_A2:
        raise NoResultError("the motor's current hardly changes")
    known, heat, wind = bridged(degc), load.heat, load.wind
    means = _means(degc)
    share, other_degc = _SHARE, math.nan
    if other is None:
        # What the motor, whose temperature is not known, gives to the body.
        other = _late(heat, _MOTOR_S)
        rough = fit(_columns(heat[None], float(np.median(_TIMES_S))), means)
        size = 0.01 if rough is None else abs(float(rough.coefficients[2]))
        share = Prior(_MOTOR_SHARE.mean * size, _MOTOR_SHARE.deviation * size)
    else:
        other_degc = float(np.nanmean(other))
        other = bridged(other) - other_degc
    inputs = np.stack([heat, other, wind, wind * (known - known.mean())])
    tried = ((time_s, fit(_columns(inputs, time_s), means, priors={3: share})) for time_s in _TIMES_S)
    fits = [(time_s, found) for time_s, found in tried if found is not None]
    if not fits:
        raise NoResultError("the temperature says too little")
    time_s, found = min(fits, key=lambda one: float(np.nansum(np.minimum(one[1].residuals ** 2, 1.0))))
    for _ in range(_ROUNDS):
        columns = _columns(inputs, time_s)
        joint = fit([*columns, _tangent(inputs, time_s, found.coefficients)], means, priors={3: share})
        if joint is None:
            raise NoResultError("the temperature does not bend enough to tell the time constant")
        found, fitted_s = joint, time_s
        time_s *= float(np.exp(np.clip(joint.coefficients[-1], -0.3, 0.3)))
    return Body(load, found, fitted_s, known, other_degc)


def _columns(inputs: Array, time_s: float) -> list[Array]:
    """Rest and start, and how the body follows each input; all as means."""
    ends = np.exp(-(np.arange(inputs.shape[1]) + 0.5) * _STEP_S / time_s)
    # A sensor is a little late, or early in its bin: the heat itself stands for that.
    rows = np.vstack([np.ones_like(ends), ends, _late(inputs, time_s), inputs[0]])
    return list(_means(rows))


def _tangent(inputs: Array, time_s: float, coefficients: Array) -> Array:
    """How the model moves with the logarithm of the time constant."""
    one, two = (_columns(inputs, time_s * factor) for factor in (0.99, 1.01))
    moved: Any = sum(c * (b - a) / 0.02 for c, a, b in zip(coefficients, one, two, strict=False))
    return np.asarray(moved, dtype=np.float64)


def _late(values: Array, time_s: float) -> Array:
    """How a body of this time constant follows, in the middle of each step."""
    ends = lagged(values, time_s / _STEP_S)
    made = ends.copy()
    made[..., 1:] += ends[..., :-1]
    return np.asarray(made / 2, dtype=np.float64)


def _means(values: Array) -> Array:
    """The means over some steps: a temperature moves slowly."""
    whole = values[..., : values.shape[-1] // _MEAN * _MEAN]
    return np.asarray(whole.reshape(*values.shape[:-1], -1, _MEAN).mean(axis=-1))


def _binned(drive: Drive, name: str) -> Array | None:
    column = drive.of(drive.vesc, name)
    return None if column is None or not np.nanstd(column) else binned(drive.seconds, column, _STEP_S)
