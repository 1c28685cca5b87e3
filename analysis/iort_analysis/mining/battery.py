"""The battery as an equivalent circuit: an open voltage by charge, a resistance, and slow resistances.

    voltage = open(charge drawn) - R0 * current - sum of R_k * lag_k(current)

(Plett, Battery Management Systems I, chapter 2). A constant open voltage, or one without the slow
resistances, puts what the battery loses over minutes onto R0. ``open`` is a smooth curve. A drive of ten
minutes barely tells a slow resistance from the falling open voltage, so each R_k begins with a prior in
proportion to R0, and its uncertainty is in the intervals of everything else."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from iort_analysis import NoResultError
from iort_analysis.drives.drive import Drive
from iort_analysis.results import Mined, Table, miner
from iort_analysis.statistics.fitting import Fit, Prior, fit
from iort_analysis.statistics.signals import (
    Array,
    averaged,
    binned,
    bridged,
    lagged,
    resolution,
    smooth_basis,
)
from iort_contract.catalog.vesc import VOLTAGE_FIELD
from iort_contract.messages.analysis import Estimate

# What is left in a battery: its charge, and how far that takes the car.
#
# Nobody says what cells a pack has, so the interval spans two curves of the voltage at rest, and a spread
# between cells beside them: a hobby charger's chart of lithium-polymer cells (blog.ampow.com, "LiPo voltage
# chart"), which falls late, and typical values of lithium-ion cells with nickel, manganese and cobalt,
# which fall early. These values are of no single cell: the spread stands for what they miss. Where a drive
# began and what it drew narrow the interval: near full both agree.

# Volts of a cell at rest by its charge.
_POLYMER = (
    (0.0, 0.05, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 0.95, 1.0),
    (3.27, 3.61, 3.69, 3.73, 3.77, 3.80, 3.84, 3.87, 3.95, 4.02, 4.11, 4.15, 4.20),
)
_ION = (
    (0.0, 0.05, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0),
    (2.90, 3.15, 3.30, 3.45, 3.54, 3.60, 3.67, 3.77, 3.86, 3.95, 4.06, 4.18),
)
# Of makes, ages and temperatures beside the curves, and of a controller's voltage of 1 % accuracy.
_SPREAD_V = 0.05
# A pack has from 80 % of its rated capacity, when it is worn out, to 105 %.
_CAPACITY = (0.8, 1.05)
_LEAST_M, _LEAST_AH = 100.0, 0.01
# Below and above, these are no cells of these kinds, or another number of them.
_CELL_V = (2.5, 4.3)

DRAWN, LEFT, RANGE = "battery_drawn_share", "battery_charge_left", "battery_range_left_km"


class Spent(NamedTuple):
    """What a drive took: charge, way, and the open voltages at its beginning and end."""

    charge_ah: float
    way_m: float | None
    first_v: Estimate
    last_v: Estimate


def charge(spent: Spent, known: Mapping[str, float]) -> tuple[dict[str, Estimate], dict[str, str]]:
    """The estimates, and the reasons for those that there are not."""
    missing = [name for name in ("capacity_ah", "cells") if known.get(name, 0) <= 0]
    if missing:
        reason = f"needs {' and '.join(missing)} of the battery: iort robots set"
        return {}, dict.fromkeys((DRAWN, LEFT, RANGE), reason)
    capacity_ah, cells = known["capacity_ah"], known["cells"]
    share = spent.charge_ah / capacity_ah
    least, most = sorted(share / part for part in _CAPACITY)
    estimates = {DRAWN: Estimate(share, least, most, "1")}
    cell_v = spent.last_v.value / cells
    if not _CELL_V[0] <= cell_v <= _CELL_V[1]:
        reason = f"{cell_v:.2f} V for each of {cells:g} cells: no lithium-polymer or lithium-ion battery"
        return estimates, dict.fromkeys((LEFT, RANGE), reason)
    left = estimates[LEFT] = _left(spent, cells, (least, most))
    if spent.way_m is None:
        return estimates, {RANGE: "needs the car's speed in m/s: iort robots set"}
    if spent.way_m < _LEAST_M or spent.charge_ah < _LEAST_AH:
        return estimates, {RANGE: f"needs {_LEAST_M:g} m of driving and {_LEAST_AH:g} Ah drawn"}
    full_km = spent.way_m / 1000 * capacity_ah / spent.charge_ah
    low, high = _CAPACITY
    estimates[RANGE] = Estimate(
        full_km * left.value, full_km * left.low * low, full_km * left.high * high, "km"
    )
    return estimates, {}


def _left(spent: Spent, cells: float, drawn: tuple[float, float]) -> Estimate:
    low, high = _by_voltage(spent.last_v, cells)
    before_low, before_high = _by_voltage(spent.first_v, cells)
    narrow = max(low, before_low - drawn[1]), min(high, before_high - drawn[0])
    # With another capacity than was told, the two do not meet.
    if narrow[0] < narrow[1]:
        low, high = narrow
    return Estimate((low + high) / 2, low, high, "1")


def _by_voltage(open_v: Estimate, cells: float) -> tuple[float, float]:
    """The least and the most charge at a voltage, as a share."""
    low_v, high_v = open_v.low / cells - _SPREAD_V, open_v.high / cells + _SPREAD_V
    low = min(float(np.interp(low_v, volts, charges)) for charges, volts in (_POLYMER, _ION))
    high = max(float(np.interp(high_v, volts, charges)) for charges, volts in (_POLYMER, _ION))
    return low, high


_CURRENT = "current_input"
_FIELDS = (VOLTAGE_FIELD, _CURRENT)
_STEP_S = 0.2
# The times of the slow resistances, and their size as a share of R0.
_LAGS_S = (10.0, 30.0, 90.0)
_SLOW, _SLOW_DEVIATION = 1 / 6, 0.1
_PIECE_S = 450.0
# Shorter drives, and such with a steadier current, say too little.
_LEAST_S, _LEAST_A = 60.0, 0.5
_MOST_ROWS = 30_000
# Long beside what filters in a controller or logger delay.
_MEAN_S = 1.5
_CURVE_POINTS = 21
_NAMES = (
    "battery_resistance_ohm",
    "battery_slow_resistance_ohm",
    "battery_open_voltage_v",
    "battery_voltage_per_ah",
    DRAWN,
    LEFT,
    RANGE,
)


class Battery(NamedTuple):
    """The fitted circuit on a drive's samples."""

    fit: Fit
    open_columns: Array
    charge_ah: Array

    def open_at(self, index: int) -> Estimate:
        """The open voltage at a row of the fit."""
        return self.fit.estimate(self._open(self.open_columns[index]), "V")

    def slope(self) -> Estimate:
        """The fall of the open voltage with the charge drawn, from the first row to the last."""
        drawn = self.charge_ah[-1] - self.charge_ah[0]
        return self.fit.estimate(self._open(self.open_columns[0] - self.open_columns[-1]) / drawn, "V/Ah")

    def _open(self, weights: Array) -> Array:
        return np.concatenate([weights, np.zeros(len(self.fit.coefficients) - len(weights))])


@miner(*_NAMES)
def mine(drive: Drive) -> Mined:
    """The battery's resistances, its open voltage against the charge drawn, and what is left in it."""
    battery = fit_battery(drive)
    resistances = len(battery.open_columns[0])
    slow = np.zeros(len(battery.fit.coefficients))
    slow[resistances + 1 :] = 1
    estimates = {
        "battery_resistance_ohm": battery.fit.of(resistances, "ohm"),
        "battery_slow_resistance_ohm": battery.fit.estimate(slow, "ohm"),
        "battery_open_voltage_v": battery.open_at(-1),
        "battery_voltage_per_ah": battery.slope(),
    }
    way_m = drive.of(drive.vesc, "distance_m")
    spent = Spent(
        float(battery.charge_ah[-1] - battery.charge_ah[0]),
        None if way_m is None else float(np.nanmax(way_m) - np.nanmin(way_m)),
        battery.open_at(0),
        battery.open_at(-1),
    )
    left, missing = charge(spent, drive.known)
    return Mined({**estimates, **left}, missing, tables={"battery": _curve(battery)})


def fit_battery(drive: Drive) -> Battery:
    """Fit the circuit to a drive; raises `NoResultError`."""
    voltage_v, current_a = drive.motor(*_FIELDS)
    seconds = drive.seconds
    if seconds[-1] < _LEAST_S:
        raise NoResultError(f"needs at least {_LEAST_S:g} s, got {seconds[-1]:.0f} s")
    if np.nanstd(current_a) < _LEAST_A:
        raise NoResultError(
            f"{_CURRENT} hardly changes, so that nothing tells the resistance from the open voltage"
        )
    steps_a = bridged(binned(seconds, current_a, _STEP_S))
    ends_s = (np.arange(len(steps_a)) + 1) * _STEP_S
    charge_ah = np.interp(seconds, ends_s, np.cumsum(steps_a) * _STEP_S / 3600)
    lags = [np.interp(seconds, ends_s, lagged(steps_a, lag_s / _STEP_S)) for lag_s in _LAGS_S]
    open_columns = np.column_stack(smooth_basis(charge_ah, math.ceil(float(seconds[-1]) / _PIECE_S)))
    design = np.column_stack([open_columns, -current_a, *(-lag for lag in lags)])
    rows = slice(None, None, -(-len(seconds) // _MOST_ROWS))
    at = open_columns.shape[1]
    fitted = _with_slow(design[rows], voltage_v[rows], at, resolution(voltage_v))
    if fitted is None:
        raise NoResultError("the drive's currents do not tell the resistance from the open voltage")
    # Voltage and current that are not of the same moment make the resistance small; their means do not.
    *slow, means_v = averaged(seconds, [*design.T, voltage_v], _MEAN_S)
    slower = _with_slow(np.column_stack(slow), means_v, at, 0.0)
    if slower is not None and slower.of(at, "ohm").low > fitted.of(at, "ohm").high:
        fitted = slower
    return Battery(fitted, open_columns, charge_ah)


def _with_slow(design: Array, voltage_v: Array, resistance: int, step_v: float) -> Fit | None:
    """The fit whose priors of the slow resistances are in proportion to the resistance that it finds."""
    columns = list(design.T)
    rough = fit(columns[: resistance + 1], voltage_v)
    if rough is None:
        return None
    size = max(abs(float(rough.coefficients[-1])), 1e-6)
    slow = range(resistance + 1, len(columns))
    priors = {index: Prior(_SLOW * size, _SLOW_DEVIATION * size) for index in slow}
    return fit(columns, voltage_v, priors=priors, resolution=step_v)


def _curve(battery: Battery) -> Table:
    """The open voltage at even steps of the charge drawn."""
    charge_ah = battery.charge_ah
    at = np.linspace(charge_ah.min(), charge_ah.max(), _CURVE_POINTS)
    order = np.argsort(charge_ah, kind="stable")
    rows = order[np.searchsorted(charge_ah[order], at).clip(0, len(charge_ah) - 1)]
    points = [battery.open_at(row) for row in rows]
    return {
        "charge_drawn_ah": charge_ah[rows],
        **{
            f"open_{part}_v": np.array([getattr(p, part) for p in points])
            for part in ("value", "low", "high")
        },
    }
