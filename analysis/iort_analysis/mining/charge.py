"""What is left in a battery: its charge, and how far that takes the car.

Nobody says what cells a pack has, so the interval spans two curves of the voltage at rest, and a spread
between cells beside them: a hobby charger's chart of lithium-polymer cells (blog.ampow.com, "LiPo voltage
chart"), which falls late, and typical values of lithium-ion cells with nickel, manganese and cobalt, which
fall early. These values are of no single cell: the spread stands for what they miss. Where a drive began and
what it drew narrow the interval: near full both agree.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from iort_contract.messages.analysis import Estimate

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
