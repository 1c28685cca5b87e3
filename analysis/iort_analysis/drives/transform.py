"""Derived quantities of a drive, and its windows."""

from __future__ import annotations

import numpy as np

from iort_analysis.drives.cleaning import pause_us
from iort_analysis.samples.blocks import Block, Column
from iort_contract.catalog.derived import Vehicle, calculable

# Acceleration is the slope of the speed over this time: a difference of two samples is mostly noise.
_SLOPE_S = 0.2


def with_derived(samples: Block, vesc: str, vehicle: Vehicle | None) -> Block:
    """The samples with the catalogue's derived fields of the motor controller, and the car's
    ``acceleration_mps2`` and ``distance_m``, which grows from 0, where its speed is known."""
    prefix = f"{vesc}."
    own = {name[len(prefix) :]: c for name, c in samples.columns.items() if name.startswith(prefix)}
    made: dict[str, Column] = {}
    for entry, parameters in calculable(own, vehicle):
        arguments = [parameters[name] if name in parameters else own[name] for name in entry.arguments]
        made[entry.name] = entry.formula(*arguments)
    speed = made.get("speed_mps")
    if speed is not None and len(speed) > 1:
        made["acceleration_mps2"] = _slope(samples, speed)
        made["distance_m"] = _sum(samples, np.abs(speed))
    return Block(samples.times_us, {**samples.columns, **{prefix + name: c for name, c in made.items()}})


def _slope(samples: Block, values: Column) -> Column:
    """The change a second, by a line through the values around each."""
    seconds = (samples.times_us - samples.times_us[0]) / 1e6
    usual = max(float(np.median(np.diff(seconds))), 1e-6)
    half = max(1, min(round(_SLOPE_S / 2 / usual), (len(values) - 1) // 2))
    ahead = np.minimum(np.arange(len(values)) + half, len(values) - 1)
    behind = np.maximum(np.arange(len(values)) - half, 0)
    took = seconds[ahead] - seconds[behind]
    made: Column = (values[ahead] - values[behind]) / np.maximum(took, 1e-9)
    # Across a pause there is no slope.
    made[took * 1e6 > pause_us(samples.times_us) + 2 * half * usual * 1e6] = np.nan
    return made


def _sum(samples: Block, rates: Column) -> Column:
    """The integral over time, which counts nothing across a pause."""
    steps = np.diff(samples.times_us)
    steps = np.where(steps > pause_us(samples.times_us), 0, steps) / 1e6
    known = np.nan_to_num(rates)
    made: Column = np.append(0.0, np.cumsum((known[1:] + known[:-1]) / 2 * steps))
    return made
