"""What changed while the car drove: the residuals of its models, by their cumulative sums."""

from __future__ import annotations

import numpy as np

from iort_analysis.drives.drive import Drive
from iort_analysis.mining.anomalies.balance import balance
from iort_analysis.mining.anomalies.cusum import Change, changed
from iort_analysis.mining.anomalies.drift import voltage_residuals
from iort_analysis.mining.anomalies.readings import DUTY, MOTOR, SPEED, VOLTAGE, Array, Readings
from iort_analysis.results import Event, Mined
from iort_analysis.statistics.signals import binned

# Means over this time are compared: about a lap's corner.
_STEP_S = 5.0
# Less of a change means nothing on a car.
_LEAST_A, _LEAST_V = 0.8, 0.2
_LEAST_DUTY = 0.2


def mine_underway(drive: Drive, samples: Readings) -> Mined:
    """An event for each model that no longer fits from some time on."""
    events = []
    fitted = balance(samples)
    if fitted is not None:
        forces, at_s, took_s = fitted
        found = _change(at_s, forces.residuals / took_s, "A")
        # Less friction than before is a warm bearing, and no finding.
        if found is not None and found[0].effect.value > _LEAST_A:
            text = "rolling takes {size} more current than before"
            events.append(_event(drive, "friction_added", (MOTOR, SPEED), found, text))
    volts = voltage_residuals(samples)
    if volts is not None:
        # The error of a voltage that hardly reaches the motor is mostly noise.
        volts = np.where(np.abs(samples.duty) > _LEAST_DUTY, volts, np.nan)
    found = None if volts is None else _change(samples.seconds, volts, "V")
    if found is not None and abs(found[0].effect.value) > _LEAST_V:
        text = "the battery's voltage is off by {size} from what duty cycle, speed and current say"
        events.append(_event(drive, "sensor_drift", (VOLTAGE, DUTY, SPEED), found, text))
    return Mined(events=events)


def _change(at_s: Array, off: Array, unit: str) -> tuple[Change, float] | None:
    """The change of the residuals, and its time in seconds."""
    means = binned(at_s, off, _STEP_S)
    places = np.flatnonzero(np.isfinite(means))
    found = changed(means[places], unit)
    return None if found is None else (found, float(places[found.place]) * _STEP_S)


def _event(drive: Drive, kind: str, fields: tuple[str, ...], found: tuple[Change, float], text: str) -> Event:
    change, since_s = found
    value, low, high, unit = change.effect
    size = f"{value:.2g} {unit} ({low:.2g} to {high:.2g})"
    since = f"from {since_s:.0f} s after the start on "
    start_us = int(drive.samples.times_us[0]) + round(since_s * 1e6)
    return Event(
        kind,
        start_us,
        drive.end_us,
        drive.vesc or "",
        fields,
        since + text.format(size=size),
        change.effect,
        change.p,
    )
