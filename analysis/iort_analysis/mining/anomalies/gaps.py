"""An intermittent link to the motor controller: its samples are missing, or the last one comes again."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from iort_analysis.drives.drive import Drive
from iort_analysis.drives.motion import motion_of
from iort_analysis.results import Event, Mined
from iort_analysis.samples.blocks import Block
from iort_analysis.statistics.intervals import sides
from iort_contract.messages.analysis import Estimate

KIND = "can_intermittent"
# A gap is longer than so many intervals between samples, and shorter than a pause.
_INTERVALS, _PAUSE_S = 4.0, 3.0
# No controller sends faster: the times of a recording that was replayed quickly are not those of its samples.
_LEAST_STEP_S = 0.001
# So many samples in a row are never equal in all their fields while the car moves.
_REPEATED = 3
# A link is intermittent with so many gaps, and with this share of the samples missing.
_LEAST_GAPS, _LEAST_SHARE = 5, 0.005
_LEAST_SAMPLES = 500


def mine_gaps(drive: Drive) -> Mined:
    """One event for all gaps of the drive, around the longest one."""
    block = drive.raw.get(drive.vesc or "")
    if block is None or len(block.times_us) < _LEAST_SAMPLES:
        return Mined()
    times = block.times_us
    steps = np.diff(times) / 1e6
    usual = max(float(np.median(steps)), _LEAST_STEP_S)
    gaps = (steps > _INTERVALS * usual) & (steps < max(_PAUSE_S, 2 * _INTERVALS * usual))
    gaps &= ~_others_pause(drive, times)
    repeated = _repeated(drive.vesc or "", block)
    lost = np.where(gaps, steps / usual - 1, 0.0) + repeated
    places = np.flatnonzero(lost)
    share = float(lost.sum() / (lost.sum() + len(times)))
    if len(places) < _LEAST_GAPS or share < _LEAST_SHARE:
        return Mined()
    longest = int(places[np.argmax(lost[places])])
    error = sides() * float(np.sqrt((lost[places] ** 2).sum())) / len(times)
    effect = Estimate(share, max(0.0, share - error), min(1.0, share + error), "1")
    text = (
        f"{share:.1%} of the controller's samples are missing ({effect.low:.1%} to {effect.high:.1%}), in "
        f"{len(places)} gaps of {np.median(lost[places]) * usual:.2g} s on average; the longest one has "
        f"{lost[longest] * usual:.2g} s"
    )
    start, end = int(times[longest]), int(times[longest + 1])
    return Mined(events=[Event(KIND, start - 2_000_000, end + 2_000_000, drive.vesc or "", (), text, effect)])


def _others_pause(drive: Drive, times: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Between which samples the other streams are silent too: that is the computer, not the link."""
    silent = np.zeros(len(times) - 1, dtype=np.bool_)
    others = [block.times_us for name, block in drive.raw.items() if name != drive.vesc]
    fast = [other for other in others if len(other) > len(times) / 10]
    for other in fast:
        # The samples of the other stream between two of the controller's; a third of the usual is silent.
        between = np.diff(np.searchsorted(other, times))
        expected = np.diff(times) / max(float(np.median(np.diff(other))), 1.0)
        silent |= (expected >= 2) & (between < expected / 3)
    return silent


def _repeated(stream: str, block: Block) -> NDArray[np.float64]:
    """Between samples: how many samples before came again and again while the car moved."""
    columns = {name: column for name, column in block.columns.items() if column.dtype.kind == "f"}
    motion = motion_of(stream, columns)
    if motion is None or len(columns) < _REPEATED:
        return np.zeros(len(block.times_us) - 1)
    same = np.ones(len(block.times_us) - 1, dtype=np.bool_)
    for column in columns.values():
        same &= (column[1:] == column[:-1]) | (np.isnan(column[1:]) & np.isnan(column[:-1]))
    moves = motion.moves(columns)
    if moves is not None:
        same &= moves[1:]
    edges = np.flatnonzero(np.diff(np.concatenate([[False], same, [False]]).astype(np.int8)))
    lost = np.zeros(len(same))
    for start, end in zip(edges[::2], edges[1::2], strict=True):
        if end - start >= _REPEATED:
            lost[start] = end - start
    return lost
