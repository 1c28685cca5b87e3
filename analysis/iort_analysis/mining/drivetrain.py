"""What the motor moves: mass, friction, drag and the losses of the gears, by Newton's law.

    mass dv/dt = force * efficiency^(+-1) - friction - drag v^2 - brake

The force at the tyres is the motor's: 1.5 * flux linkage * (electrical rad/s per m/s) newtons an ampere, so
that the mass follows from the electrical fit, without a scale. The gears' losses work against the motion:
they divide the current's effect when the motor brakes, which tells them from the mass. ``brake`` is a force
that stays when braking is over, and falls within seconds: none on a healthy car. Without flux linkage or gain
only the ratios to the force of an ampere and to the mass are known.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from iort_analysis import NoResultError
from iort_analysis.drives.cleaning import pause_us
from iort_analysis.drives.drive import Drive
from iort_analysis.mining.gain import fit_gain
from iort_analysis.mining.motor import RAD_S_PER_ERPM, Motor, fit_motor
from iort_analysis.results import Mined, attempt, merge, miner
from iort_analysis.statistics.fitting import Fit, Part, fit, propagated
from iort_analysis.statistics.signals import Array, summed
from iort_contract.catalog.car import KNOWN
from iort_contract.messages.analysis import Estimate

_WINDOW_S = 0.5
# Slower, friction is not constant, and a stand hides forces.
_LEAST_MPS = 0.3
# The motor brakes with more than this; a brake that drags lets go in this time.
_BRAKES_A, _RELEASE_S = 2.0, 4.0
_LEAST_A = 1.0
# Places of coefficients of the motion: the drag, and the first of the four of the slip.
_DRAG, _SLIPS = 3, 5
# The share of the friction that the tyres carry, a bit more than half: no field tells. A prior.
_BEYOND = Part(np.array([0.57]), np.array([[0.08**2]]), np.array([[0.08**2]]))
# The mass that the motor moves, for that which does not turn.
_TURNING = 1.1
_GAIN = "speed_to_erpm_gain"
_FORCES = (
    "motor_force_n_per_a",
    "effective_mass_kg",
    "friction_n",
    "drag_n_s2_per_m2",
    "drivetrain_efficiency",
    "brake_drag_n",
)
# An efficiency may come out so far above 1 by chance.
_SHARES, _BEYOND_ONE = frozenset({"drivetrain_efficiency"}), 0.1
# What the motor moves is the car and what turns in it; with a load, it is some times what was registered.
_LEAST_OF_KNOWN, _MOST_OF_KNOWN = 0.5, 5.0
_RATIOS = ("acceleration_per_a_mps2", "friction_per_mass_mps2")


def mine(drive: Drive) -> Mined:
    """The gain, the mass that the motor moves, and what holds the car back."""
    gain, motor = attempt(fit_gain, drive), attempt(fit_motor, drive)
    if isinstance(gain, str):
        found = Mined(missing={_GAIN: gain})
        registered = None if drive.vehicle is None else drive.vehicle.speed_to_erpm_gain
    else:
        found = Mined({_GAIN: gain.of(0, "erpm per m/s")})
        registered = float(gain.coefficients[0])
    return merge([found, _mine_forces(drive, gain, motor, registered)])


@miner(*_FORCES, *_RATIOS)
def _mine_forces(drive: Drive, gain: Fit | str, motor: Motor | str, registered: float | None) -> Mined:
    """What holds the car back, by the ``registered`` gain or the drive's own."""
    if registered is None:
        default = f", also if it is {drive.known[_GAIN]:g}, the default" if _GAIN in drive.known else ""
        raise NoResultError(f"needs the gain: {gain}; or register the car's own{default}: iort robots set")
    motion = _fit_motion(drive, registered)
    found = (
        Mined(_ratios(drive, motion, registered), dict.fromkeys(_FORCES, motor))
        if isinstance(motor, str)
        else _forces(drive, motion, motor, gain, registered)
    )
    forces = {**found.estimates, "drivetrain_efficiency": _efficiency(motion)}
    if impossible := _impossible(forces, drive.known.get("mass_kg")):
        raise NoResultError(impossible)
    return found


def _impossible(forces: Mapping[str, Estimate], known_kg: float | None) -> str:
    """Why no car has these forces; empty if one may. They come of one fit, so one of them tells of all."""
    limits = dict.fromkeys(("friction_n", "brake_drag_n"), (0.0, math.inf))
    limits["drivetrain_efficiency"] = (0.0, 1.0)
    limits["effective_mass_kg"] = (
        (KNOWN["mass_kg"].least, KNOWN["mass_kg"].most)
        if known_kg is None
        else (_LEAST_OF_KNOWN * known_kg, _MOST_OF_KNOWN * known_kg)
    )
    for name, (least, most) in limits.items():
        estimate = forces.get(name)
        if estimate is None:
            continue
        # Where the truth is the limit, one interval of 90 % in twenty lies beyond it by chance; of twice the
        # width it is one in two thousand.
        margin = (estimate.high - estimate.low) / 2
        if (
            estimate.high + margin < least
            or estimate.low - margin > most
            or (name in _SHARES and estimate.value > most + _BEYOND_ONE)
        ):
            limit = f"at least {least:g}" if estimate.value < least else f"at most {most:g}"
            unit = "" if estimate.unit == "1" else f" {estimate.unit}"
            return (
                f"impossible: {name} would be {estimate.value:.3g}{unit}, and is {limit}{unit} in any car: "
                "look at the gain and at the motor's current"
            )
    return ""


def _ratios(drive: Drive, motion: Fit, gain: float) -> dict[str, Estimate]:
    """What is left without the motor's flux linkage: forces for each kg."""
    speed2, moved = _mean_square(drive, gain), motion.part()

    def per_amp(c: Array) -> Any:
        return math.sqrt(max(c[0] * c[1], 0.0)) * _coasting(c, speed2)

    return {
        "acceleration_per_a_mps2": propagated(per_amp, moved, unit="m/s2/A"),
        "friction_per_mass_mps2": propagated(lambda c: c[2] * _coasting(c, speed2), moved, unit="m/s2"),
    }


def _mean_square(drive: Drive, gain: float) -> float:
    """The mean square of the speed over the way, in m2/s2."""
    speed = np.abs(drive.motor("speed")[0] / gain)
    return float(np.nansum(speed**3) / max(float(np.nansum(speed)), 1e-12))


def _fit_motion(drive: Drive, gain: float) -> Fit:
    """Coefficients: driving and braking acceleration an ampere, friction, drag and brake for each kg."""
    speed, current = drive.motor("speed", "current_motor", reason="needs the motor's speed and current_motor")
    if np.nanstd(current) < _LEAST_A:
        raise NoResultError("the motor's current hardly changes")
    offset = 0.0 if drive.vehicle is None else drive.vehicle.speed_to_erpm_offset
    speed = (speed - offset) / gain
    seconds, way = drive.seconds, np.sign(speed)
    drives = current * way >= 0
    rates = [
        np.where(drives, current, 0.0),
        np.where(drives, 0.0, current),
        -way,
        -speed * np.abs(speed),
        -way * _dragging(seconds, ~drives & (np.abs(current) > _BRAKES_A)),
    ]
    usable = np.isfinite(speed) & np.isfinite(current) & (np.abs(speed) > _LEAST_MPS)
    edges, whole = _windows(drive, usable)
    columns = [np.where(whole, _integrals(seconds, rate, edges), np.nan) for rate in rates]
    # Tyres slip in proportion to their force, so the wheels are faster than the car while it accelerates.
    slips = [speed * np.where(drives, current, 0.0), speed * np.where(drives, 0.0, current)]
    slips += [slip * current for slip in slips]
    columns += [np.diff(slip[edges]) for slip in slips]
    # Speed and current are not measured at quite the same time.
    columns += [np.diff(np.where(way, current, 0.0)[edges]) for way in (drives, ~drives)]
    wanted = np.where(whole, np.diff(speed[edges]), np.nan)
    found = fit(columns, wanted)
    if found is not None and found.coefficients[0] > 0:
        c = found.coefficients
        # The air feels the car's speed, not the wheels'.
        car = speed - np.einsum("i,ij->j", c[_SLIPS : _SLIPS + 4], np.stack(slips))
        columns[_DRAG] = np.where(whole, _integrals(seconds, -car * np.abs(car), edges), np.nan)
        # With the drag the parts that turn take less of the tyres' force.
        wanted = wanted - (_TURNING - 1) * c[_SLIPS] / c[0] * c[_DRAG] * np.diff(speed[edges] ** 3)
        found = fit(columns, wanted)
    if found is None or min(found.coefficients[:2]) <= 0:
        raise NoResultError("the drive's accelerations do not tell mass from friction")
    return found


def _forces(drive: Drive, motion: Fit, motor: Motor, gain: Fit | str, used_gain: float) -> Mined:
    """The forces, which the motor's flux linkage scales."""
    flux, moved, none = motor.fit.part(0), motion.part(), np.zeros((1, 1))
    gains = Part(np.array([used_gain]), none, none) if isinstance(gain, str) else gain.part(0)

    def per_amp(flux_wb: float, erpm_per_mps: float) -> float:
        return 1.5 * flux_wb * RAD_S_PER_ERPM * erpm_per_mps

    speed2 = _mean_square(drive, used_gain)

    def rolling(c: Array) -> float:
        """The wheels' speed for the car's, over the drive: tyres carry friction and drag."""
        return 1 + _slipped(c[2:]) * (float(c[-1]) + _dragged(c[2:], speed2))

    def mass_kg(c: Array) -> Any:
        # The accelerations were found with the gain, too. Both are of wheels that slip.
        seen = per_amp(c[0], c[1]) / math.sqrt(max(c[2] * c[3], 1e-12)) * c[1] / used_gain
        return seen / rolling(c) / _coasting(c[2:], speed2)

    def force_n(c: Array, index: int) -> Any:
        return mass_kg(c) * c[index] * _coasting(c[2:], speed2)

    parts = (flux, gains, moved, _BEYOND)
    estimates = {
        "motor_force_n_per_a": propagated(lambda c: per_amp(c[0], c[1]) / rolling(c), *parts, unit="N/A"),
        "effective_mass_kg": propagated(mass_kg, *parts, unit="kg"),
        "friction_n": propagated(lambda c: force_n(c, 4), *parts, unit="N"),
        "drag_n_s2_per_m2": propagated(
            # A force for the square of a speed that is too high by so much.
            lambda c: mass_kg(c) * c[5] / _coasting(c[2:], speed2),
            *parts,
            unit="N s2/m2",
        ),
        "drivetrain_efficiency": _efficiency(motion),
        "brake_drag_n": propagated(lambda c: force_n(c, 6), *parts, unit="N"),
    }
    missing = {}
    known_kg = drive.known.get("mass_kg")
    if known_kg is None:
        missing["rotating_mass_kg"] = "needs the car's mass: the motor moves both"
    else:
        moved_kg = estimates["effective_mass_kg"]
        estimates["rotating_mass_kg"] = moved_kg._replace(
            value=moved_kg.value - known_kg, low=moved_kg.low - known_kg, high=moved_kg.high - known_kg
        )
    return Mined(estimates, missing)


def _efficiency(motion: Fit) -> Estimate:
    """By what an ampere does while the motor drives, and while it brakes."""
    moved = motion.part()
    return propagated(lambda c: math.sqrt(max(c[0] / c[1], 0.0)), moved, unit="1")


def _slipped(motion: Array) -> float:
    """How much faster the wheels are under the force that holds the car against its friction."""
    return float(motion[_SLIPS] * motion[2] / max(motion[0], 1e-12))


def _dragged(motion: Array, speed2: float) -> float:
    """The drag's share in what the tyres carry, for the friction."""
    return float(_TURNING * motion[_DRAG] * speed2 / max(motion[2], 1e-12))


def _coasting(motion: Array, speed2: float) -> float:
    """The car's speed for that of the motion: of wheels without a current, by the drive's mean gain."""
    return 1 + _slipped(motion) * (1 + _dragged(motion, speed2))


def _dragging(seconds: Array, brakes: NDArray[np.bool_]) -> Array:
    """1 while the motor brakes, and falling after it."""
    last = np.maximum.accumulate(np.where(brakes, seconds, -np.inf))
    return np.asarray(np.exp((last - seconds) / _RELEASE_S), dtype=np.float64)


def _windows(drive: Drive, usable: NDArray[np.bool_]) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """The samples between the windows, and which windows are without a pause and usable as a whole."""
    times = drive.samples.times_us
    edges = np.searchsorted(times, np.arange(times[0], times[-1], round(_WINDOW_S * 1e6)))
    edges = np.unique(np.append(edges, len(times) - 1))
    paused = np.append(0, np.cumsum((np.diff(times) > pause_us(times)) | ~usable[1:]))
    return edges, (np.diff(paused[edges]) == 0) & usable[edges[:-1]]


def _integrals(seconds: Array, rate: Array, edges: NDArray[np.int64]) -> Array:
    return np.asarray(np.diff(summed(seconds, rate)[edges]), dtype=np.float64)
