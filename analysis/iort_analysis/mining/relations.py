"""What a drive's fields say of each other: the balance of forces, sensors that drift, warming, slip."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from iort_analysis import NoResultError
from iort_analysis.drives.cleaning import pause_us
from iort_analysis.drives.drive import Drive
from iort_analysis.results import Mined, miner
from iort_analysis.statistics.distributions import mean_of, sides
from iort_analysis.statistics.fitting import Fit, fit
from iort_analysis.statistics.signals import Array, binned, bridged, lagged, summed
from iort_contract.catalog.vesc import TEMPERATURES
from iort_contract.messages.analysis import Estimate

Mask = NDArray[np.bool_]

SPEED, MOTOR, BATTERY, DUTY, VOLTAGE = (
    "speed",
    "current_motor",
    "current_input",
    "duty_cycle",
    "voltage_input",
)
# Beyond it the controller cannot turn the duty cycle up, and regulates otherwise.
FULL_DUTY = 0.93
# Electrical revolutions a minute: what moves, and what moves fast.
KRPM = 1000.0
MOVING_KRPM = 2.0
# Shorter drives say nothing of a drift, and too little of anything else.
LEAST_S = 60.0


class Readings(NamedTuple):
    """Samples of a drive: seconds since its first one, thousands of erpm, amperes, share, volts."""

    seconds: Array
    krpm: Array
    motor_a: Array
    duty: Array
    voltage_v: Array
    battery_a: Array

    def summed(self, values: Array) -> Array:
        """The integral over time up to each sample."""
        return summed(self.seconds, values)


def readings(drive: Drive) -> Readings:
    """The readings of a drive; raises `NoResultError` if it has none."""
    seconds = drive.seconds
    if not len(seconds) or seconds[-1] < LEAST_S:
        raise NoResultError(
            f"the drive must last {LEAST_S:g} s, got {seconds[-1] if len(seconds) else 0:.0f} s"
        )
    names = (SPEED, MOTOR, DUTY, VOLTAGE, BATTERY)
    absent = [name for name in names if drive.of(drive.vesc, name) is None]
    speed, *others = drive.motor(*names, reason=f"the drive has no {' and no '.join(absent)}")
    return Readings(seconds, speed / KRPM, *others)


# The balance of forces: what current the car needs to accelerate, to roll, and to pull against its brake.
#
#     change of speed = (integral of current - rolling - drag * speed^2 - brake * e) / inertia
#
# over 0.4 s while the motor drives, where e is 1 when the motor brakes and falls to a third in four seconds.
# The integral of both sides needs no derivative of the speed, which is mostly noise. All is in the motor's
# current and speed, so that neither the car's mass nor its gears need be known. A change of the current bends
# the tyres, which turns the wheels a little: it has a term of its own.

INERTIA, ROLLING, BRAKE = "inertia_a_per_krpm_s", "rolling_current_a", "brake_drag_a"
# Steps, and the time over which both sides are integrated.
_BALANCE_STEP_S, _OVER = 0.1, 4
# A brake holds on for this time after the motor braked with more than this.
_HOLDS_S, _BRAKES_A = 4.0, 2.0
_DRIVES_A = 1.0
_SMOOTHED = 5
_LEAST_ROWS = 200


@miner(INERTIA, ROLLING, BRAKE)
def mine_balance(samples: Readings) -> Mined:
    """The inertia, the rolling resistance and the brake's drag, as currents."""
    found, _, _ = balance(samples)
    return Mined({INERTIA: found.of(0, "A s/krpm"), ROLLING: found.of(1, "A"), BRAKE: found.of(3, "A")})


def balance(samples: Readings) -> tuple[Fit, Array, float]:
    """The fit of the current with inertia, rolling, drag and brake; the times of its rows, and the time that
    each of them spans, in seconds. Raises `NoResultError`."""
    t, speed, amps = samples.seconds, np.abs(samples.krpm), samples.motor_a * np.sign(samples.krpm)
    brakes = amps < -_BRAKES_A
    last = np.maximum.accumulate(np.where(brakes, t, -np.inf))
    held = np.exp(-(t - last) / _HOLDS_S)
    other = brakes | ~(amps > _DRIVES_A) | ~(speed > MOVING_KRPM)
    other[1:] |= np.diff(t) > pause_us((t * 1e6).astype(np.int64)) / 1e6
    grid = np.arange(0.0, t[-1], _BALANCE_STEP_S)
    smooth = np.ones(_SMOOTHED) / _SMOOTHED

    def over(values: Array) -> Array:
        there = np.interp(grid, t, values)
        return np.asarray(there[_OVER:] - there[:-_OVER])

    def smoothed(values: Array) -> Array:
        return np.convolve(np.nan_to_num(values), smooth, "same")

    wanted = over(samples.summed(amps))
    wanted[over(samples.summed(other.astype(float))) > 1e-6] = np.nan
    enough = np.isfinite(wanted).sum() >= _LEAST_ROWS
    took = np.full(len(wanted), _OVER * _BALANCE_STEP_S)
    middle = np.interp(grid[:-_OVER] + took / 2, t, np.nan_to_num(speed))
    drag, brake = over(samples.summed(speed**2)), over(samples.summed(held))
    columns = [over(smoothed(speed)), took, drag, brake, middle * over(smoothed(amps))]
    fitted = fit(columns, wanted) if enough else None
    if fitted is None:
        raise NoResultError("the motor must drive the car for a minute at several speeds and accelerations")
    return fitted, grid[:-_OVER] + took / 2, _OVER * _BALANCE_STEP_S


# Sensors that drift, against what the other fields say.
#
# - The battery's voltage times the duty cycle is the motor's voltage, which follows its speed and current.
# - The motor's current times the duty cycle is the battery's current, but for what the electronics need.
#
# Each relation is fitted with an error of the sensor that grows along the drive; the estimate is the error at
# the end of the drive less that at its beginning. The other sensors' errors and the car's own parameters drop
# out, since they are the same all along the drive; a motor that warms up has a term of its own.

VOLTAGE_DRIFT, CURRENT_DRIFT = "voltage_drift_v", "motor_current_drift_a"
_DRIFT_STEP_S, _DRIFT_LEAST_S = 0.2, 180.0
# The error is a straight line between so many points of time, at least so far apart.
_MOST_KNOTS, _KNOT_S = 8, 60.0


@miner(VOLTAGE_DRIFT, CURRENT_DRIFT)
def mine_drift(samples: Readings) -> Mined:
    """The drifts that the drive's fields allow."""
    if samples.seconds[-1] < _DRIFT_LEAST_S:
        raise NoResultError(f"the drive must last {_DRIFT_LEAST_S:g} s")
    steady = _steady(samples)
    fits = {VOLTAGE_DRIFT: _voltage(samples, steady), CURRENT_DRIFT: _current(samples, steady)}
    reason = "the drive must have several speeds and currents all along"
    return Mined(
        {name: found for name, found in fits.items() if found is not None},
        {name: reason for name, found in fits.items() if found is None},
    )


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
        binned(t, np.where(steady, column, np.nan), _DRIFT_STEP_S) for column in (*columns, *errors, wanted)
    ]
    return fit(binned_columns[:-1], binned_columns[-1])


def _along(t: Array) -> list[Array]:
    """Columns whose sums are all curves of straight lines along the drive, from 0 on."""
    knots = int(np.clip(t[-1] / _KNOT_S, 2, _MOST_KNOTS))
    place = t / t[-1] * (knots - 1)
    return [np.clip(1 - np.abs(place - knot), 0, 1) for knot in range(1, knots)]


# A board's temperature that drifts away from how the board warms up.
#
#     temperature = a + b * lag(1) + c * lag(current^2) + d * time
#
# where the lag is the board's own time, found by the fit, and ``d`` is the drift. A board that cools worse
# has a longer lag and still no drift. A motor that warms the board for an hour, and air that warms up, have
# one.

TEMPERATURE_DRIFT, LAG = "temperature_drift_k", "controller_lag_s"
_WARMING_STEP_S, _WARMING_LEAST_S = 2.0, 240.0
_LAGS_S = tuple(float(lag) for lag in np.geomspace(20, 2000, 14))
_ROUNDS = 4


@miner(TEMPERATURE_DRIFT, LAG)
def mine_warming(drive: Drive, samples: Readings) -> Mined:
    """The drift of the controller's temperature over the drive."""
    column = next((c for name in TEMPERATURES if (c := drive.of(drive.vesc, name)) is not None), None)
    if column is None:
        raise NoResultError("the drive has no temperature of the controller")
    if samples.seconds[-1] < _WARMING_LEAST_S:
        raise NoResultError(f"the drive must last {_WARMING_LEAST_S:g} s")
    degc = binned(samples.seconds, np.asarray(column, dtype=np.float64), _WARMING_STEP_S)
    heat = bridged(binned(samples.seconds, samples.motor_a**2, _WARMING_STEP_S))
    fitted, lag_s = _best(degc, heat)
    # The last coefficient is what the logarithm of the lag is still off.
    value, low, high = (lag_s * float(np.exp(off)) for off in fitted.of(4, "1")[:3])
    return Mined({TEMPERATURE_DRIFT: fitted.of(3, "K"), LAG: Estimate(value, low, high, "s")})


def _best(degc: Array, heat: Array) -> tuple[Fit, float]:
    """The fit with the best lag, whose uncertainty is in the others' covariance; and the lag in seconds."""
    fits = [(lag, found) for lag in _LAGS_S if (found := fit(_columns(heat, lag)[:4], degc)) is not None]
    if not fits:
        raise NoResultError("the temperature says too little")
    lag, found = min(fits, key=lambda one: float(np.nansum(np.abs(one[1].residuals))))
    for _ in range(_ROUNDS):
        columns = _columns(heat, lag)
        # How the model moves with the logarithm of the lag.
        nudged = _columns(heat, lag * 1.02)
        parts = zip(columns, nudged, found.coefficients, strict=False)
        tangent = sum((size * (other - column) / 0.02 for column, other, size in parts), np.zeros(len(degc)))
        joint = fit([*columns, tangent], degc)
        if joint is None:
            raise NoResultError("the temperature says too little")
        found, fitted_at = joint, lag
        lag *= float(np.exp(np.clip(joint.coefficients[4], -0.3, 0.3)))
    return found, fitted_at


def _columns(heat: Array, lag_s: float) -> list[Array]:
    steps = lag_s / _WARMING_STEP_S
    mean = float(heat.mean())
    return [
        np.ones(len(heat)),
        lagged(np.ones(len(heat)), steps),
        lagged((heat - mean) / max(mean, 1e-9), steps),
        np.linspace(0, 1, len(heat)),
    ]


# Slip: the motor's speed beside that of the car's pose, with torque and without.

SLIP = "slip_under_torque"
# Distances over this time are compared: long enough for a pose with a centimetre's noise.
_OVER_S = 0.25
# Nearly no torque is below this share of the high currents, and much torque is above that one.
_HIGH, _IDLE, _TORQUE = 0.95, 0.25, 0.6
# The drive in so many parts gives the gain's interval.
_PARTS, _LEAST, _LEAST_PULLS = 20, 200, 20


class _Ways(NamedTuple):
    """The motor's turns in thousands, the car's way in metres, and the mean current, over some time."""

    turns: Array
    moved_m: Array
    amps: Array


@miner(SLIP)
def mine_slip(drive: Drive, samples: Readings) -> Mined:
    """How much further the wheels turn with much torque than without."""
    pose = None if drive.pose in {None, drive.vesc} else drive.streams[drive.pose or ""]
    if pose is None or len(pose.times_us) < _LEAST:
        raise NoResultError("the drive has no second source of speed, such as a pose")
    ways = _ways(
        (pose.times_us - drive.samples.times_us[0]) / 1e6, pose.columns["x"], pose.columns["y"], samples
    )
    if len(ways.turns) < _LEAST:
        raise NoResultError("the car hardly moves")
    high = float(np.quantile(ways.amps, _HIGH))
    idle, pulls = np.abs(ways.amps) < _IDLE * high, ways.amps > _TORQUE * high
    if idle.sum() < _LEAST / 2 or pulls.sum() < _LEAST_PULLS:
        raise NoResultError("the car hardly drives with and without torque")
    parts = np.array_split(np.flatnonzero(idle), _PARTS)
    gains = np.array([float(ways.turns[part].sum() / ways.moved_m[part].sum()) for part in parts])
    gain, low, high = mean_of(gains)
    # What the wheels turned further in this drive; the pose's noise is the error, as it is without torque.
    noise_m = float(np.std(ways.moved_m[idle] - ways.turns[idle] / gain))
    turned_m = float(ways.turns[pulls].sum()) / gain
    slip = 1 - float(ways.moved_m[pulls].sum()) / turned_m
    half = math.hypot(sides() * noise_m * math.sqrt(float(pulls.sum())) / turned_m, (high - low) / 2 / gain)
    return Mined(estimates={SLIP: Estimate(slip, slip - half, slip + half, "1")})


def _ways(seconds: Array, x_m: Array, y_m: Array, samples: Readings) -> _Ways:
    """Forward ways over `_OVER_S`, where motor and pose are known all the time."""
    step = max(1, round(_OVER_S / float(np.median(np.diff(seconds)))))

    def over(values: Array) -> Array:
        return np.asarray(np.diff(values[::step]))

    def total(values: Array) -> Array:
        return over(np.interp(seconds, samples.seconds, samples.summed(values)))

    turns, took = total(samples.krpm), over(seconds)
    gaps = total(np.isnan(samples.krpm * samples.motor_a).astype(np.float64))
    moved_m = np.hypot(over(x_m), over(y_m))
    known = np.isfinite(moved_m) & (took < 2 * _OVER_S) & (gaps == 0) & (turns > MOVING_KRPM * took)
    return _Ways(turns[known], moved_m[known], (total(samples.motor_a) / took)[known])
