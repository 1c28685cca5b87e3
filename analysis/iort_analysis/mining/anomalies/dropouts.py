"""A battery's cell that drops out: the voltage falls below what the load explains, and comes back."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from iort_analysis.drives.drive import Drive
from iort_analysis.mining.anomalies.readings import BATTERY, VOLTAGE, Array, Readings
from iort_analysis.results import Event, Mined
from iort_analysis.statistics.fitting import fit
from iort_analysis.statistics.signals import binned, bridged, smooth_basis
from iort_contract.messages.analysis import Estimate

KIND = "cell_dropout"
_STEP_S = 0.1
# The open voltage is a smooth curve with a piece for so long.
_PIECE_S, _MOST_PIECES = 120.0, 8
# A dropout is so far below the model, in volts and in deviations, for at least so many steps.
_LEAST_V, _SIGMAS, _LEAST_STEPS = 0.3, 10.0, 4
_MAD = 1.4826
_SHOWN_US = 3_000_000
Steps = NDArray[np.int64]


def mine_dropouts(drive: Drive, samples: Readings) -> Mined:
    """One event for the dropouts of a drive, at the deepest one."""
    voltage = binned(samples.seconds, samples.voltage_v, _STEP_S)
    current = binned(samples.seconds, samples.battery_a, _STEP_S)
    at_s = np.arange(len(voltage), dtype=np.float64) * _STEP_S
    # What the battery loses slowly follows the current of the last ten seconds.
    slow = np.convolve(bridged(current), np.ones(100) / 100)[: len(current)]
    pieces = min(_MOST_PIECES, max(1, round(samples.seconds[-1] / _PIECE_S)))
    fitted = fit([*smooth_basis(at_s, pieces), current, slow], voltage)
    if fitted is None:
        return Mined(missing={KIND: "the battery's load must change"})
    off = fitted.residuals
    sigma = _MAD * float(np.nanmedian(np.abs(off)))
    depths, starts, ends = _falls(off, max(_LEAST_V, _SIGMAS * sigma))
    if not len(depths):
        return Mined()
    deepest = int(np.argmax(depths))
    first_us = int(drive.samples.times_us[0])
    start_us, end_us = (first_us + round(1e6 * _STEP_S * int(at[deepest])) for at in (starts, ends))
    low, high = np.quantile(depths, [0.05, 0.95])
    effect = Estimate(float(np.median(depths)), float(low), float(high), "V")
    lasted_s = float(np.median(ends - starts)) * _STEP_S
    times = f"{len(depths)} times" if len(depths) > 1 else "once"
    text = (
        f"the battery's voltage fell {times} below what the load explains, by {effect.value:.2g} V "
        f"({low:.2g} V to {high:.2g} V) for {lasted_s:.1f} s, and came back"
    )
    return Mined(
        events=[
            Event(
                KIND,
                start_us - _SHOWN_US,
                end_us + _SHOWN_US,
                drive.vesc or "",
                (VOLTAGE, BATTERY),
                text,
                effect,
            )
        ]
    )


def _falls(off: Array, least_v: float) -> tuple[Array, Steps, Steps]:
    """The depth of each fall, its first step and the one after its last."""
    below = np.concatenate([[False], off < -least_v, [False]])
    edges = np.flatnonzero(below[1:] != below[:-1])
    starts, ends = edges[::2].astype(np.int64), edges[1::2].astype(np.int64)
    long = ends - starts >= _LEAST_STEPS
    starts, ends = starts[long], ends[long]
    depths = np.array([-float(np.nanmedian(off[a:b])) for a, b in zip(starts, ends, strict=True)])
    return depths, starts, ends
