"""The motor's electrical parameters, by the equations of a synchronous motor that VESC's controller uses too.

    vq = R iq + w L id + w flux        vd = R id - w L iq        (w in electrical rad/s, amplitudes a phase)

A driver that reports vq and iq gives R, L and the flux linkage. With the basic fields only, duty cycle times
battery voltage is sqrt(3) times the length of (vd, vq) in field-oriented control, so that

    duty * voltage / sqrt(3) = R i + w flux + (w L i)^2 / (2 duty * voltage / sqrt(3)),

whose last part is small. With six-step control the same product is the voltage across two phases. The mode is
known from the battery's current: the firmware calculates it as duty * current * sqrt(3)/2 in the first mode,
as duty * current in the second. So the battery's power is no second measurement of the motor's losses.
Torque for each ampere needs the number of pole pairs; the force at the tyres does not.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from iort_analysis import NoResultError
from iort_analysis.drives.drive import Drive
from iort_analysis.results import Mined, attempt, miner
from iort_analysis.statistics.fitting import Fit, Prior, fit, propagated
from iort_analysis.statistics.signals import Array, averaged, binned, bridged, lagged
from iort_contract.catalog.vesc import VOLTAGE_FIELD
from iort_contract.messages.analysis import Estimate

RAD_S_PER_ERPM = 2 * math.pi / 60
# Copper's resistance grows by this share a kelvin; the resistance is given at this temperature.
COPPER_PER_K, REFERENCE_DEGC = 0.0039, 25.0
# The share of the resistance that is the winding's, and so grows with the motor's temperature; the MOSFETs
# and wires have the rest.
_WINDING, _WINDING_DEVIATION = 0.8, 0.15
# Battery current for duty cycle times motor current in field-oriented and in six-step control.
_FOC, _SIX_STEP = math.sqrt(3) / 2, 1.0
# Slower, the modulation is mostly the controller's dead time; faster, it is cut off.
_LEAST_ERPM, _MOST_DUTY = 500.0, 0.94
_LEAST_A, _LEAST_V = 1.0, 0.1
# Samples, and the correlation of currents that one controller calculated from another.
_LEAST_ROWS, _LEAST_CORRELATION = 100, 0.8
_MOST_ROWS = 60_000
# The time between samples by which speed and voltage may be apart, as a share; and that of means.
_LATE, _MEAN_S = 0.5, 0.1
# The time in which a motor warms, where no sensor tells.
_HEAT_S, _HEAT_STEP_S = 300.0, 1.0
# A board's dead time is felt in full from about this current on.
_DEAD_A = 1.0
# A shorter time of motion, and a resistance that is known to this share of itself only, are none.
_LEAST_S, _WIDEST = 20.0, 0.5
_UNKNOWN_OHM = (
    "the drive tells the resistance as {value:.2g} ohm from {low:.2g} to {high:.2g} only: its currents change"
    " too little, or speed and voltage are too far apart in time"
)
_NAMES = ("motor_resistance_ohm", "motor_flux_linkage_wb", "motor_inductance_h", "motor_torque_nm_per_a")


class Motor(NamedTuple):
    """The fit of a motor: its first coefficients are the flux linkage in Wb and the resistance in ohm."""

    fit: Fit
    at_reference: bool
    inductance: Estimate | None

    @property
    def flux_linkage(self) -> Estimate:
        """The flux linkage."""
        return self.fit.of(0, "Wb")

    @property
    def resistance(self) -> Estimate:
        """The resistance of a phase with its MOSFETs and wires: at 25 degC, or as it was in the drive."""
        return self.fit.of(1, "ohm")

    @property
    def unknown_ohm(self) -> str:
        """Why the drive does not tell the resistance; empty if it does."""
        ohm = self.resistance
        if ohm.value > 0 and ohm.high - ohm.value < _WIDEST * ohm.value:
            return ""
        return _UNKNOWN_OHM.format(**ohm._asdict())


def mine(drive: Drive) -> Mined:
    """The motor's resistance, flux linkage and inductance."""
    motor = attempt(fit_motor, drive)
    if isinstance(motor, str):
        return replace(_mine_ratios(drive), missing=dict.fromkeys(_NAMES, motor))
    estimates = {"motor_flux_linkage_wb": motor.flux_linkage}
    missing = {}
    name = "motor_resistance_25_ohm" if motor.at_reference else "motor_resistance_ohm"
    if motor.unknown_ohm:
        missing[name] = motor.unknown_ohm
    else:
        estimates[name] = motor.resistance
    if not motor.at_reference:
        missing["motor_resistance_25_ohm"] = (
            "needs temp_motor: the resistance is that of the drive's mean heat"
        )
    if motor.inductance is None:
        missing["motor_inductance_h"] = "needs avg_vd and avg_iq that depend on it: duty_cycle hardly does"
    else:
        estimates["motor_inductance_h"] = motor.inductance
    pairs = drive.known.get("pole_pairs")
    if pairs is None:
        missing["motor_torque_nm_per_a"] = "needs the motor's number of pole pairs, which no field depends on"
    else:
        estimates["motor_torque_nm_per_a"] = propagated(
            lambda flux: 1.5 * pairs * float(flux[0]), motor.fit.part(0), unit="Nm/A"
        )
    return Mined(estimates, missing)


# Three miners need it of the same drive.
@lru_cache(maxsize=1)
def fit_motor(drive: Drive) -> Motor:
    """Fit the motor's equations to a drive; raises `NoResultError`."""
    (speed,) = drive.motor("speed", reason="needs the motor's speed")
    vq, iq = (drive.of(drive.vesc, name) for name in ("avg_vq", "avg_iq"))
    _check_moves(drive, speed)
    rows = slice(None, None, -(-len(speed) // _MOST_ROWS))
    if vq is not None and iq is not None and np.nanstd(vq) and np.nanstd(iq):
        return _from_axes(drive, speed[rows], vq[rows], iq[rows], rows)
    return _from_duty(drive, speed[rows], rows)


def _check_moves(drive: Drive, speed: Array) -> None:
    """Raise `NoResultError` if the drive has too little motion to tell anything of the motor."""
    moves_s = float(np.mean(np.abs(speed) > _LEAST_ERPM)) * float(drive.seconds[-1])
    if moves_s < _LEAST_S:
        raise NoResultError(
            f"needs {_LEAST_S:g} s of motion faster than {_LEAST_ERPM:g} erpm, got {moves_s:.0f} s"
        )


def _from_axes(drive: Drive, speed: Array, vq: Array, iq: Array, rows: slice) -> Motor:
    # A motor that stands under current shows its resistance best.
    usable = (np.abs(speed) > _LEAST_ERPM) | (np.abs(iq) > np.nanmax(np.abs(iq)) / 2)
    omega = np.where(usable, speed, np.nan) * RAD_S_PER_ERPM
    _check_changes(iq)
    vd = drive.of(drive.vesc, "avg_vd")
    # The length of the voltage is right even where the controller's angle is late.
    volts = vq if vd is None else np.copysign(np.hypot(vd[rows], vq), vq)
    same = [] if vd is None else [vq]
    duty, voltage = drive.of(drive.vesc, "duty_cycle"), drive.of(drive.vesc, VOLTAGE_FIELD)
    if duty is not None and voltage is not None:
        same.append(duty[rows] * voltage[rows] / math.sqrt(3))
    squares = [] if vd is None else [_square(omega, iq, volts)]
    found = _with_winding(drive, [omega, iq], [volts, *same], rows, *squares)
    return Motor(*found, _inductance(drive, omega, iq, rows))


def _check_changes(current: Array) -> None:
    if np.nanstd(current) < _LEAST_A:
        raise NoResultError("the motor's current hardly changes")


def _inductance(drive: Drive, omega: Array, iq: Array, rows: slice) -> Estimate | None:
    """The inductance from vd, beside what a controller adds to it whose angle is late: flux * delay * w^2."""
    vd = drive.of(drive.vesc, "avg_vd")
    found = None if vd is None else fit([-omega * iq, omega * np.abs(omega)], vd[rows])
    inductance = None if found is None else found.of(0, "H")
    return inductance if inductance is not None and inductance.low > 0 else None


def _from_duty(drive: Drive, speed: Array, rows: slice) -> Motor:
    needs = "needs avg_vq and avg_iq, or duty_cycle, voltage_input and current_motor"
    names = ("duty_cycle", VOLTAGE_FIELD, "current_motor")
    duty, voltage, current = (column[rows] for column in drive.motor(*names, reason=needs))
    _check_changes(current)
    needs = "needs current_input: without it the control mode, and so the scale, is not known"
    battery = drive.motor("current_input", reason=needs)[0][rows]
    usable = (np.abs(speed) > _LEAST_ERPM) & (np.abs(duty) < _MOST_DUTY)
    _check_field_oriented(np.where(usable, duty * current, np.nan), battery)
    omega = np.where(usable, speed, np.nan) * RAD_S_PER_ERPM
    volts = duty * voltage / math.sqrt(3)
    squares = _square(omega, current, volts)
    return Motor(*_with_winding(drive, [omega, current], [volts], rows, squares), None)


def _square(omega: Array, current: Array, volts: Array) -> Array:
    """What the inductance adds to the length of the voltage, for its square."""
    known = np.where(np.abs(volts) > _LEAST_V, volts, np.nan)
    return np.asarray((omega * current) ** 2 / (2 * known), dtype=np.float64)


@miner()
def _mine_ratios(drive: Drive) -> Mined:
    """What is left where the voltages' scale is not known: the shares of speed and current in them."""
    names = ("speed", "duty_cycle", VOLTAGE_FIELD, "current_motor", "current_input")
    speed, duty, voltage, current, battery = drive.motor(*names)
    _check_moves(drive, speed)
    usable = (np.abs(speed) > _LEAST_ERPM) & (np.abs(duty) < _MOST_DUTY)
    krpm, volts = np.where(usable, speed / 1000, np.nan), duty * voltage
    follows = _follows(np.where(usable, duty * current, np.nan), battery)
    found = fit([krpm, current], volts) if follows else None
    if found is None:
        return Mined()
    tried = [fit([krpm, current, beyond], volts) for beyond in _beyond(krpm, current)]
    found = found.beside([one for one in tried if one is not None], (0, 1))
    return Mined({"motor_volts_per_krpm": found.of(0, "V/krpm"), "motor_volts_per_a": found.of(1, "V/A")})


def _follows(modulated: Array, battery: Array) -> bool:
    """Whether the battery's current follows duty cycle times motor current, as the firmware calculates it."""
    known = np.isfinite(modulated) & np.isfinite(battery)
    if known.sum() < _LEAST_ROWS:
        return False
    return float(np.corrcoef(modulated[known], battery[known])[0, 1]) > _LEAST_CORRELATION


def _check_field_oriented(modulated: Array, battery: Array) -> None:
    """Raise `NoResultError` if the scale of the voltages is not known."""
    if not _follows(modulated, battery):
        raise NoResultError(
            "current_input does not follow duty_cycle times current_motor, as the firmware calculates it:"
            " the driver's currents are other ones"
        )
    mode = fit([modulated, np.ones(len(modulated))], battery)
    ratio = math.nan if mode is None else float(mode.coefficients[0])
    # NaN is not field-oriented either.
    if not abs(ratio - _FOC) <= (_SIX_STEP - _FOC) / 2:
        raise NoResultError(
            f"current_input is {ratio:.2f} of duty_cycle times current_motor, field-oriented control gives"
            f" {_FOC:.2f}: only sums of phases are known"
        )


def _with_winding(
    drive: Drive, columns: list[Array], volts: Sequence[Array], rows: slice, *more: Array
) -> tuple[Fit, bool]:
    """The fit, whose resistance grows with the motor's temperature where that is known; and if so.

    The first of ``volts`` is fitted; the others are the same voltage as other fields tell it.
    """
    omega, current = columns
    unknown = "the drive's speeds and currents do not tell resistance from flux linkage"
    rough = fit([*columns, *more], volts[0])
    if rough is None:
        raise NoResultError(unknown)
    flux, size = (abs(float(one)) for one in rough.coefficients[:2])
    seconds = drive.seconds[rows]
    # The speed may be older or newer than the voltage by part of the time between samples.
    apart_s = float(np.median(np.diff(drive.seconds)))
    late = np.gradient(omega, seconds)
    priors = {2: Prior(0.0, _LATE * apart_s * flux)}
    degc = drive.of(drive.vesc, "temp_motor")
    warms = degc is not None and bool(np.nanstd(degc))
    if degc is not None and warms:
        warmer = current * COPPER_PER_K * (degc[rows] - REFERENCE_DEGC)
        priors[3] = Prior(_WINDING * size, _WINDING_DEVIATION * size)
    else:
        # The winding warms with the current's square, some minutes late.
        squares = current**2
        heat = _late(seconds, squares)
        warmer = current * (heat - np.nansum(squares * heat) / np.nansum(squares))
    beyond = _beyond(omega, current)
    # Means, since noise of a current that follows the acceleration makes the resistance small.
    means = averaged(seconds, [omega, current, late, warmer, *more, *beyond, *volts], _MEAN_S)
    first = 4 + len(more)
    equations, others = means[:first], means[first : first + len(beyond)]
    wanted, *same = means[first + len(beyond) :]
    found = fit(equations, wanted, priors=priors)
    if found is None:
        raise NoResultError(unknown)
    tried = [fit([*equations, *beyond], wanted, priors=priors) for beyond in (*zip(others), others)]
    tried += [fit(equations, other, priors=priors) for other in same]
    return found.beside([one for one in tried if one is not None], (0, 1)), warms


def _beyond(speed: Array, current: Array) -> list[Array]:
    """What the equations leave out: dead time, and a voltage for the speed that is no straight line."""
    return [np.tanh(current / _DEAD_A), speed * np.abs(speed)]


def _late(seconds: Array, values: Array) -> Array:
    """The values as a body of some minutes' heat capacity follows them."""
    steps = bridged(binned(seconds, values, _HEAT_STEP_S))
    ends_s = (np.arange(len(steps)) + 1) * _HEAT_STEP_S
    return np.interp(seconds, ends_s, lagged(steps, _HEAT_S / _HEAT_STEP_S))
