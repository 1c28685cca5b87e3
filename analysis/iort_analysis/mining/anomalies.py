"""Anomalies: sensors that fail, and faults that show in how a drive's fields go together."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from iort_analysis.drives.drive import FROZEN, Drive, Repair, motion_among, motion_of
from iort_analysis.mining.changes import mine_dropouts, mine_underway
from iort_analysis.mining.relations import mine_balance, mine_drift, mine_slip, mine_warming, readings
from iort_analysis.results import Event, Mined, attempt, merge
from iort_analysis.samples.blocks import Block
from iort_analysis.statistics.distributions import sides
from iort_analysis.statistics.signals import runs
from iort_contract.catalog.vesc import FAULT_FIELD, FAULTS
from iort_contract.messages.analysis import Estimate

# A robot that records and never moves: it stood, or its speed is not what the analysis takes it for.

_MOTIONLESS = "never_moved"
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
    most = np.nanmax(np.abs(speed))
    text = (
        f"the robot recorded {(end_us - start_us) / 1e6:,.0f} s and never moved: "
        f"{motion.stream}.{motion.field} was {most:.3g} {motion.unit} at most, "
        f"and above {motion.least:g} it moves"
    )
    return Mined(events=[Event(_MOTIONLESS, start_us, end_us, motion.stream, (motion.field,), text)])


# Faults that the motor controller reports itself.

_FAULT = "fault_reported"


def mine_faults(drive: Drive) -> Mined:
    """An event for each code, over the longest time that it was reported without a break."""
    block = drive.raw.get(drive.vesc or "")
    column = None if block is None else block.columns.get(FAULT_FIELD)
    if block is None or column is None or column.dtype.kind != "f":
        return Mined()
    codes = np.nan_to_num(column)
    events = []
    for code in np.unique(codes[codes != 0]).tolist():
        first, behind = runs(codes == code)
        starts, ends = block.times_us[first], block.times_us[behind - 1]
        longest = int(np.argmax(ends - starts))
        count = float(len(starts))
        times = "once" if len(starts) == 1 else f"{len(starts)} times"
        text = f"fault {code:.0f}, {FAULTS.get(int(code), 'unknown')}: reported {times}"
        effect = Estimate(count, count, count, "1")
        start_us, end_us = int(starts[longest]), int(ends[longest])
        events.append(Event(_FAULT, start_us, end_us, drive.vesc or "", (FAULT_FIELD,), text, effect))
    return Mined(events=events)


# Sensors that are stuck: the cleaning has found where a value stood still while the car moved.

_STUCK = "sensor_stuck"
# So many fields at once are not their sensors' fault, but that of the link: `gaps` finds it.
_LINK = 5


def mine_frozen(drive: Drive) -> Mined:
    """An event for each sensor that was stuck. Fields that stand still together are one sensor's."""
    frozen = [repair for repair in drive.repairs if repair.kind == FROZEN]
    sensors: dict[tuple[str, ...], list[list[Repair]]] = {}
    for together in _together(frozen):
        fields = _fields(together)
        if len(fields) < _LINK:
            sensors.setdefault((together[0].stream, *fields), []).append(together)
    return Mined(events=[_event(drive, times) for _, times in sorted(sensors.items())])


def _together(repairs: Iterable[Repair]) -> Iterable[list[Repair]]:
    """The repairs of each stream in groups that overlap in time."""
    group: list[Repair] = []
    for repair in sorted(repairs, key=lambda one: (one.stream, one.start_us, one.field)):
        if group and (repair.stream != group[0].stream or repair.start_us > group[0].end_us):
            yield group
            group = []
        group.append(repair)
    if group:
        yield group


def _fields(together: Iterable[Repair]) -> tuple[str, ...]:
    """The fields of some repairs, each once."""
    return tuple(dict.fromkeys(repair.field for repair in together))


def _event(drive: Drive, times: list[list[Repair]]) -> Event:
    longest = max((group[0] for group in times), key=lambda repair: repair.end_us - repair.start_us)
    fields = _fields(times[0])
    # It stood from some time after the sample before to some time before the sample after.
    seconds = (longest.end_us - longest.start_us) / 1e6
    step_s = float(np.median(np.diff(drive.streams[longest.stream].times_us))) / 1e6
    effect = Estimate(seconds, seconds, seconds + 2 * step_s, "s")
    text = f"the value of {' and '.join(fields)} stayed the same for {seconds:.3g} s while the car moved"
    if len(times) > 1:
        text += f", the longest of {len(times)} times"
    return Event(_STUCK, longest.start_us, longest.end_us, longest.stream, fields, text, effect)


# An intermittent link to the motor controller: its samples are missing, or the last one comes again.

_DROPS = "can_intermittent"
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
    return Mined(
        events=[Event(_DROPS, start - 2_000_000, end + 2_000_000, drive.vesc or "", (), text, effect)]
    )


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
    lost = np.zeros(len(same))
    for start, end in zip(*runs(same), strict=True):
        if end - start >= _REPEATED:
            lost[start] = end - start
    return lost


def mine(drive: Drive) -> Mined:
    """All anomalies of a drive."""
    parts = [test(drive) for test in (mine_motionless, mine_faults, mine_frozen, mine_gaps)]
    samples = attempt(readings, drive)
    if isinstance(samples, str):
        parts.append(Mined(missing={"anomalies": samples}))
    else:
        parts += [mine_balance(samples), mine_drift(samples)]
        parts += [test(drive, samples) for test in (mine_warming, mine_slip, mine_dropouts, mine_underway)]
    return merge(parts)
