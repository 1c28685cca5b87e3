"""The balance of forces: what current the car needs to accelerate, to roll, and to pull against its brake.

    change of speed = (integral of current - rolling - drag * speed^2 - brake * e) / inertia

over 0.4 s while the motor drives, where e is 1 when the motor brakes and falls to a third in four seconds.
The integral of both sides needs no derivative of the speed, which is mostly noise. All is in the motor's
current and speed, so that neither the car's mass nor its gears need be known. A change of the current bends
the tyres, which turns the wheels a little: it has a term of its own.
"""

from __future__ import annotations

import numpy as np

from iort_analysis.drives.cleaning import pause_us
from iort_analysis.mining.anomalies.readings import MOVING_KRPM, Array, Readings
from iort_analysis.results import Mined
from iort_analysis.statistics.fitting import Fit, fit

INERTIA, ROLLING, BRAKE = "inertia_a_per_krpm_s", "rolling_current_a", "brake_drag_a"
# Steps, and the time over which both sides are integrated.
_STEP_S, _OVER = 0.1, 4
# A brake holds on for this time after the motor braked with more than this.
_HOLDS_S, _BRAKES_A = 4.0, 2.0
_DRIVES_A = 1.0
_SMOOTHED = 5
_LEAST_ROWS = 200


def mine_balance(samples: Readings) -> Mined:
    """The inertia, the rolling resistance and the brake's drag, as currents."""
    fitted = balance(samples)
    if fitted is None:
        reason = "the motor must drive the car for a minute at several speeds and accelerations"
        return Mined(missing=dict.fromkeys((INERTIA, ROLLING, BRAKE), reason))
    found, _, _ = fitted
    inertia = found.of(0, "A s/krpm")
    return Mined(
        estimates={INERTIA: inertia, ROLLING: found.of(1, "A"), BRAKE: found.of(3, "A")},
    )


def balance(samples: Readings) -> tuple[Fit, Array, float] | None:
    """The fit of the current with inertia, rolling, drag and brake; the times of its rows, and the time that
    each of them spans, in seconds."""
    t, speed, amps = samples.seconds, np.abs(samples.krpm), samples.motor_a * np.sign(samples.krpm)
    brakes = amps < -_BRAKES_A
    last = np.maximum.accumulate(np.where(brakes, t, -np.inf))
    held = np.exp(-(t - last) / _HOLDS_S)
    other = brakes | ~(amps > _DRIVES_A) | ~(speed > MOVING_KRPM)
    other[1:] |= np.diff(t) > pause_us((t * 1e6).astype(np.int64)) / 1e6
    grid = np.arange(0.0, t[-1], _STEP_S)
    smooth = np.ones(_SMOOTHED) / _SMOOTHED

    def over(values: Array) -> Array:
        there = np.interp(grid, t, values)
        return np.asarray(there[_OVER:] - there[:-_OVER])

    def smoothed(values: Array) -> Array:
        return np.convolve(np.nan_to_num(values), smooth, "same")

    wanted = over(samples.summed(amps))
    wanted[over(samples.summed(other.astype(float))) > 1e-6] = np.nan
    if np.isfinite(wanted).sum() < _LEAST_ROWS:
        return None
    took = np.full(len(wanted), _OVER * _STEP_S)
    middle = np.interp(grid[:-_OVER] + took / 2, t, np.nan_to_num(speed))
    fitted = fit(
        [
            over(smoothed(speed)),
            took,
            over(samples.summed(speed**2)),
            over(samples.summed(held)),
            middle * over(smoothed(amps)),
        ],
        wanted,
    )
    return None if fitted is None else (fitted, grid[:-_OVER] + took / 2, _OVER * _STEP_S)
