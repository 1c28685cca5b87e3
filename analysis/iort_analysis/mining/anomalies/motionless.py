"""A robot that records and never moves: it stood, or its speed is not what the analysis takes it for."""

from __future__ import annotations

import numpy as np

from iort_analysis.drives.drive import Drive
from iort_analysis.drives.motion import motion_among
from iort_analysis.results import Event, Mined

KIND = "never_moved"
# A shorter recording may have ended before the car could move.
_LEAST_US = 10_000_000


def mine_motionless(drive: Drive) -> Mined:
    """One event if the field that tells of motion says all along that the robot stands."""
    motion = motion_among({name: block.columns for name, block in drive.streams.items()})
    if motion is None:
        return Mined()
    block = drive.streams[motion.stream]
    speed, moves = block.columns[motion.field], motion.moves(block.columns)
    if moves is None or moves.any() or bool(np.isnan(speed).all()):
        return Mined()
    start_us, end_us = int(block.times_us[0]), int(block.times_us[-1])
    if end_us - start_us < _LEAST_US:
        return Mined()
    lasted_s, most, name = (
        (end_us - start_us) / 1e6,
        np.nanmax(np.abs(speed)),
        f"{motion.stream}.{motion.field}",
    )
    text = (
        f"the robot recorded {lasted_s:,.0f} s and never moved: {name} was {most:.3g} {motion.unit} at most, "
        f"and above {motion.least:g} it moves"
    )
    return Mined(events=[Event(KIND, start_us, end_us, motion.stream, (motion.field,), text)])
