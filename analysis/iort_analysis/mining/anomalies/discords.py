"""Discords: the stretch of a drive that is most unlike all others, where it stands out."""

from __future__ import annotations

import math

import numpy as np

from iort_analysis.drives.drive import Drive
from iort_analysis.mining.anomalies.profile import matrix_profile
from iort_analysis.mining.anomalies.readings import MOTOR, MOVING_KRPM, SPEED, Array, Mask, Readings
from iort_analysis.results import Event, Mined
from iort_analysis.statistics.signals import binned, bridged
from iort_contract.messages.analysis import Estimate

KIND = "pattern_unusual"
# Stretches of this time, in at most so many steps of at least this time.
_LONG_S, _MOST_STEPS, _LEAST_STEP_S = 8.0, 2400, 0.5
# The nearest neighbour is so many times as far as it usually is at worst.
_STANDS_OUT = 1.6
# A drive has a discord that is likelier than this every now and then.
_LIKELY = 1e-3
# Fewer stretches beside each other say nothing of what is usual.
_LEAST_BLOCKS = 30
_EULER = 0.5772156649


def mine_discords(drive: Drive, samples: Readings) -> Mined:
    """One event for the stretch of the motor's current that is like no other, if there is one."""
    step_s = max(_LEAST_STEP_S, float(samples.seconds[-1]) / _MOST_STEPS)
    m = max(8, round(_LONG_S / step_s))
    current = binned(samples.seconds, samples.motor_a, step_s)
    speed = bridged(binned(samples.seconds, np.abs(samples.krpm), step_s))
    # A start and a stop are like no other stretch, and usual.
    moves = np.convolve(speed <= MOVING_KRPM, np.ones(2 * m + 1), "same")[: len(speed)] < 0.5
    usable = _whole(moves & np.isfinite(current), m)
    profile = matrix_profile(bridged(current), m, usable)
    found = _standing_out(profile, m)
    if found is None:
        return Mined()
    place, effect, p = found
    start_us = int(drive.samples.times_us[0]) + round(place * step_s * 1e6)
    text = (
        f"the motor's current over these {m * step_s:.0f} s is like no other stretch of the drive: the most "
        f"similar one is {effect.value:.1f} times as far away as the rarest others are from theirs"
    )
    end_us = start_us + round(m * step_s * 1e6)
    return Mined(events=[Event(KIND, start_us, end_us, drive.vesc or "", (MOTOR, SPEED), text, effect, p)])


def _whole(good: Mask, m: int) -> Mask:
    """At which places a stretch begins that is good all along."""
    bad = np.cumsum(np.insert(~good, 0, False))
    whole = np.zeros(len(good), dtype=np.bool_)
    whole[: len(good) - m + 1] = bad[m:] == bad[:-m]
    return whole


def _standing_out(profile: Array, m: int) -> tuple[int, Estimate, float] | None:
    """The place of the discord, how far it stands out, and its chance by the largest distances elsewhere,
    which are Gumbel's."""
    blocks = len(profile) // m
    if blocks < _LEAST_BLOCKS:
        return None
    parts = profile[: blocks * m].reshape(blocks, m)
    largest = np.array([np.nanmax(part) for part in parts if np.isfinite(part).any()])
    if len(largest) < _LEAST_BLOCKS:
        return None
    place = int(np.nanargmax(profile))
    # Without the discord's own stretch, which spans two blocks at most.
    others = np.sort(largest)[:-2]
    ratio = float(profile[place]) / float(others[-1])
    if ratio < _STANDS_OUT:
        return None
    scale = max(float(others.std(ddof=1)) * math.sqrt(6) / math.pi, 1e-9)
    away = (float(profile[place]) - float(others.mean()) + _EULER * scale) / scale
    p = min(1.0, len(largest) * -math.expm1(-math.exp(-away)))
    if p > _LIKELY:
        return None
    error = float(others.std(ddof=1)) / float(others[-1])
    return place, Estimate(ratio, ratio - error, ratio + error, "1"), p
