"""The battery as an equivalent circuit: an open voltage by charge, a resistance, and slow resistances.

    voltage = open(charge drawn) - R0 * current - sum of R_k * lag_k(current)

(Plett, Battery Management Systems I, chapter 2). A constant open voltage, or one without the slow
resistances, puts what the battery loses over minutes onto R0. ``open`` is a smooth curve. A drive of ten
minutes barely tells a slow resistance from the falling open voltage, so each R_k begins with a prior in
proportion to R0, and its uncertainty is in the intervals of everything else.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from iort_analysis.drives.drive import Drive
from iort_analysis.mining.charge import DRAWN, LEFT, RANGE, Spent, charge
from iort_analysis.results import Mined, Table
from iort_analysis.statistics.fitting import Fit, Prior, fit
from iort_analysis.statistics.signals import averaged, binned, bridged, lagged, resolution, smooth_basis
from iort_contract.catalog.vesc import VOLTAGE_FIELD
from iort_contract.messages.analysis import Estimate

Array = NDArray[np.float64]

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


def mine(drive: Drive) -> Mined:
    """The battery's resistances, its open voltage against the charge drawn, and what is left in it."""
    battery = fit_battery(drive)
    if isinstance(battery, str):
        return Mined(missing=dict.fromkeys(_NAMES, battery))
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


def fit_battery(drive: Drive) -> Battery | str:
    """Fit the circuit to a drive; or the reason why that cannot be done."""
    voltage_v, current_a = (drive.of(drive.vesc, name) for name in _FIELDS)
    if voltage_v is None or current_a is None:
        return f"needs {' and '.join(_FIELDS)}"
    seconds = drive.seconds
    if seconds[-1] < _LEAST_S:
        return f"needs at least {_LEAST_S:g} s, got {seconds[-1]:.0f} s"
    if np.nanstd(current_a) < _LEAST_A:
        return f"{_CURRENT} hardly changes, so that nothing tells the resistance from the open voltage"
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
        return "the drive's currents do not tell the resistance from the open voltage"
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
