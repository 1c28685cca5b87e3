"""What changes within a drive: the residuals of its models, and a battery's cell that drops out."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from iort_analysis.drives.drive import Drive
from iort_analysis.mining.relations import (
    BATTERY,
    DUTY,
    MOTOR,
    SPEED,
    VOLTAGE,
    Readings,
    balance,
    voltage_residuals,
)
from iort_analysis.results import Event, Mined, attempt
from iort_analysis.statistics.distributions import sides
from iort_analysis.statistics.fitting import fit
from iort_analysis.statistics.signals import MAD_TO_SIGMA, Array, binned, bridged, runs, smooth_basis
from iort_contract.messages.analysis import Estimate

_LEAST = 30
# Before and after a change there is at least this share of the series.
_SHARE = 0.1


class Change(NamedTuple):
    """The first value after a change of the mean, the change, and its chance if there was none."""

    place: int
    effect: Estimate
    p: float


def changed(values: Array, unit: str) -> Change | None:
    """The most likely change of the mean of a series; None for a short or constant one.

    The chance is that of the largest distance of a Brownian bridge, as for Kolmogorov's test. The deviation
    is that of means over long times (Bartlett's window), so that neighbours may be alike.
    """
    n = len(values)
    if n < _LEAST:
        return None
    sums = np.cumsum(values - values.mean())
    margin = max(2, round(_SHARE * n))
    places = np.arange(margin, n - margin + 1)
    away = np.abs(sums[places - 1])
    # The two pieces of the least squares: where the sum itself is largest would lie too near the middle.
    place = int(places[np.argmax(away**2 / (places * (n - places)))])
    before, after = values[:place], values[place:]
    # About their own means, or a change would hide itself.
    within = np.concatenate([before - before.mean(), after - after.mean()])
    deviation = _long_run(within)
    if not deviation:
        return None
    distance = float(away.max()) / (deviation * math.sqrt(n))
    value = float(after.mean() - before.mean())
    half = sides() * deviation * math.sqrt(1 / len(before) + 1 / len(after))
    return Change(place, Estimate(value, value - half, value + half, unit), _beyond(distance))


def _long_run(values: Array) -> float:
    """The deviation that the mean of n values has, times the root of n."""
    n = len(values)
    lags = round(2 * n ** (1 / 3))
    variance = float(values @ values) / n
    for lag in range(1, lags + 1):
        variance += 2 * (1 - lag / (lags + 1)) * float(values[lag:] @ values[:-lag]) / n
    # Two means were taken out at the place that fits best, and the window cuts off what lies beyond it: that
    # hides the more of the deviation, the longer the window is.
    hidden = n / (n - 2 * (lags + 1))
    return float(hidden * math.sqrt(max(variance, float(values @ values) / n / 4)))


def _beyond(distance: float) -> float:
    """The chance that a Brownian bridge goes further than this."""
    if distance < 0.3:
        return 1.0
    terms = (2 * (-1) ** (k + 1) * math.exp(-2 * (k * distance) ** 2) for k in range(1, 20))
    return min(1.0, max(0.0, math.fsum(terms)))


# What changed while the car drove: the residuals of its models, by their cumulative sums.

# Means over this time are compared: about a lap's corner.
_MEANS_S = 5.0
# Less of a change means nothing on a car.
_LEAST_A, _CHANGE_V = 0.8, 0.2
_LEAST_DUTY = 0.2


def mine_underway(drive: Drive, samples: Readings) -> Mined:
    """An event for each model that no longer fits from some time on."""
    events = []
    fitted = attempt(balance, samples)
    if not isinstance(fitted, str):
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
    if found is not None and abs(found[0].effect.value) > _CHANGE_V:
        text = "the battery's voltage is off by {size} from what duty cycle, speed and current say"
        events.append(_event(drive, "sensor_drift", (VOLTAGE, DUTY, SPEED), found, text))
    return Mined(events=events)


def _change(at_s: Array, off: Array, unit: str) -> tuple[Change, float] | None:
    """The change of the residuals, and its time in seconds."""
    means = binned(at_s, off, _MEANS_S)
    places = np.flatnonzero(np.isfinite(means))
    found = changed(means[places], unit)
    return None if found is None else (found, float(places[found.place]) * _MEANS_S)


def _event(drive: Drive, kind: str, fields: tuple[str, ...], found: tuple[Change, float], text: str) -> Event:
    change, since_s = found
    value, low, high, unit = change.effect
    size = f"{value:.2g} {unit} ({low:.2g} to {high:.2g})"
    since = f"from {since_s:.0f} s after the start on "
    start_us = int(drive.samples.times_us[0]) + round(since_s * 1e6)
    said, vesc = since + text.format(size=size), drive.vesc or ""
    return Event(kind, start_us, drive.end_us, vesc, fields, said, change.effect, change.p)


# A battery's cell that drops out: the voltage falls below what the load explains, and comes back.

KIND = "cell_dropout"
_DROPOUT_STEP_S = 0.1
# The open voltage is a smooth curve with a piece for so long.
_PIECE_S, _MOST_PIECES = 120.0, 8
# A dropout is so far below the model, in volts and in deviations, for at least so many steps.
_LEAST_V, _SIGMAS, _LEAST_STEPS = 0.3, 10.0, 4
_SHOWN_US = 3_000_000
Steps = NDArray[np.int64]


def mine_dropouts(drive: Drive, samples: Readings) -> Mined:
    """One event for the dropouts of a drive, at the deepest one."""
    voltage = binned(samples.seconds, samples.voltage_v, _DROPOUT_STEP_S)
    current = binned(samples.seconds, samples.battery_a, _DROPOUT_STEP_S)
    at_s = np.arange(len(voltage), dtype=np.float64) * _DROPOUT_STEP_S
    # What the battery loses slowly follows the current of the last ten seconds.
    slow = np.convolve(bridged(current), np.ones(100) / 100)[: len(current)]
    pieces = min(_MOST_PIECES, max(1, round(samples.seconds[-1] / _PIECE_S)))
    fitted = fit([*smooth_basis(at_s, pieces), current, slow], voltage)
    if fitted is None:
        return Mined(missing={KIND: "the battery's load must change"})
    off = fitted.residuals
    sigma = MAD_TO_SIGMA * float(np.nanmedian(np.abs(off)))
    depths, starts, ends = _falls(off, max(_LEAST_V, _SIGMAS * sigma))
    if not len(depths):
        return Mined()
    deepest = int(np.argmax(depths))
    first_us = int(drive.samples.times_us[0])
    start_us, end_us = (first_us + round(1e6 * _DROPOUT_STEP_S * int(at[deepest])) for at in (starts, ends))
    low, high = np.quantile(depths, [0.05, 0.95])
    effect = Estimate(float(np.median(depths)), float(low), float(high), "V")
    lasted_s = float(np.median(ends - starts)) * _DROPOUT_STEP_S
    times = f"{len(depths)} times" if len(depths) > 1 else "once"
    text = (
        f"the battery's voltage fell {times} below what the load explains, by {effect.value:.2g} V "
        f"({low:.2g} V to {high:.2g} V) for {lasted_s:.1f} s, and came back"
    )
    shown_us = start_us - _SHOWN_US, end_us + _SHOWN_US
    return Mined(events=[Event(KIND, *shown_us, drive.vesc or "", (VOLTAGE, BATTERY), text, effect)])


def _falls(off: Array, least_v: float) -> tuple[Array, Steps, Steps]:
    """The depth of each fall, its first step and the one after its last."""
    starts, ends = runs(off < -least_v)
    long = ends - starts >= _LEAST_STEPS
    starts, ends = starts[long], ends[long]
    depths = np.array([-float(np.nanmedian(off[a:b])) for a, b in zip(starts, ends, strict=True)])
    return depths, starts, ends
