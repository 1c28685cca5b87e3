"""Sensors that drift, against what the other fields say.

- The battery's voltage times the duty cycle is the motor's voltage, which follows its speed and current.
- The motor's current times the duty cycle is the battery's current, but for what the electronics need.

Each relation is fitted with an error of the sensor that grows along the drive; the estimate is the error at
the end of the drive less that at its beginning. The other sensors' errors and the car's own parameters drop
out, since they are the same all along the drive; a motor that warms up has a term of its own.
"""

from __future__ import annotations

import numpy as np

from iort_analysis.mining.anomalies.readings import FULL_DUTY, MOVING_KRPM, Array, Mask, Readings
from iort_analysis.results import Mined
from iort_analysis.statistics.fitting import Fit, fit
from iort_analysis.statistics.signals import binned
from iort_contract.messages.analysis import Estimate

VOLTAGE_DRIFT, CURRENT_DRIFT = "voltage_drift_v", "motor_current_drift_a"
_STEP_S, _LEAST_S = 0.2, 180.0
# The error is a straight line between so many points of time, at least so far apart.
_MOST_KNOTS, _KNOT_S = 8, 60.0


def mine_drift(samples: Readings) -> Mined:
    """The drifts that the drive's fields allow."""
    if samples.seconds[-1] < _LEAST_S:
        reason = f"the drive must last {_LEAST_S:g} s"
        return Mined(missing=dict.fromkeys((VOLTAGE_DRIFT, CURRENT_DRIFT), reason))
    steady = _steady(samples)
    fits = {VOLTAGE_DRIFT: _voltage(samples, steady), CURRENT_DRIFT: _current(samples, steady)}
    estimates = {name: found for name, found in fits.items() if found is not None}
    missing = {
        name: "the drive must have several speeds and currents all along"
        for name in fits
        if name not in estimates
    }
    return Mined(estimates=estimates, missing=missing)


def voltage_residuals(samples: Readings) -> Array | None:
    """What the battery's voltage reads more than speed, current and duty cycle say, for each sample."""
    columns = [np.where(_steady(samples), column, np.nan) for column in _motor(samples)]
    found = fit(columns, samples.duty * samples.voltage_v)
    return None if found is None else found.residuals / samples.duty


def _steady(samples: Readings) -> Mask:
    return (np.abs(samples.duty) < FULL_DUTY) & (np.abs(samples.krpm) > MOVING_KRPM)


def _motor(samples: Readings) -> list[Array]:
    """What the motor's voltage is made of. The winding warms up, and with it its resistance; the inductance
    adds to the voltage at speed."""
    t, krpm, amps = samples.seconds, samples.krpm, samples.motor_a
    return [krpm, amps, amps * t / t[-1], krpm * np.abs(amps)]


def _voltage(samples: Readings, steady: Mask) -> Estimate | None:
    # An error of the current is one of the motor's voltage, which does not follow the duty cycle.
    columns = [*_motor(samples), *_along(samples.seconds)]
    found = _with_error(samples, samples.duty * samples.voltage_v, columns, steady)
    return None if found is None else found.of(len(found.coefficients) - 1, "V")


def _current(samples: Readings, steady: Mask) -> Estimate | None:
    columns = [samples.duty * samples.motor_a, np.ones(len(samples.seconds))]
    found = _with_error(samples, samples.battery_a, columns, steady)
    if found is None or not found.coefficients[0]:
        return None
    share, last = found.coefficients[0], found.of(len(found.coefficients) - 1, "A")
    low, high = sorted((-last.low / share, -last.high / share))
    return Estimate(-last.value / share, low, high, "A")


def _with_error(samples: Readings, wanted: Array, columns: list[Array], steady: Mask) -> Fit | None:
    """The fit of a relation with a sensor's error, which acts times the duty cycle; its last coefficient is
    the error at the end, that at the beginning is 0."""
    t = samples.seconds
    errors = [error * samples.duty for error in _along(t)]
    binned_columns = [
        binned(t, np.where(steady, column, np.nan), _STEP_S) for column in (*columns, *errors, wanted)
    ]
    return fit(binned_columns[:-1], binned_columns[-1])


def _along(t: Array) -> list[Array]:
    """Columns whose sums are all curves of straight lines along the drive, from 0 on."""
    knots = int(np.clip(t[-1] / _KNOT_S, 2, _MOST_KNOTS))
    place = t / t[-1] * (knots - 1)
    return [np.clip(1 - np.abs(place - knot), 0, 1) for knot in range(1, knots)]
