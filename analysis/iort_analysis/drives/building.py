"""A drive from its streams as recorded: cleaned, on one clock, with derived quantities."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from iort_analysis.drives.cleaning import ANGLES, clean, numeric, pause_us
from iort_analysis.drives.drive import Drive, Motion, Repair, motion_among, pose_of, vesc_of, with_position
from iort_analysis.samples.blocks import EMPTY, Block, Column, ordered
from iort_analysis.statistics.signals import summed
from iort_contract.catalog.derived import Vehicle, calculable
from iort_contract.messages.analysis import DriveKey

# One clock for all streams: the samples of each at the times of one of them.


def on_one_clock(streams: Mapping[str, Block], master: str | None) -> Block:
    """All fields at the times of the stream ``master``, as ``<stream>.<field>``.

    A value between two samples lies on the line between them; across a pause, and before the first and after
    the last sample, nothing is known. Without a master it is the stream with the most samples.
    """
    if not streams:
        return EMPTY
    master = master or max(streams, key=lambda name: (len(streams[name].times_us), name))
    times = streams[master].times_us
    columns = {f"{master}.{name}": column for name, column in streams[master].columns.items()}
    for stream, block in streams.items():
        if stream != master:
            pause = pause_us(block.times_us)
            for name, column in block.columns.items():
                columns[f"{stream}.{name}"] = at(times, block.times_us, column, pause, angle=name in ANGLES)
    return Block(times, columns)


def at(
    wanted: NDArray[np.int64], times: NDArray[np.int64], column: Column, pause: int, *, angle: bool = False
) -> Column:
    """A field at other times; NaN within pauses."""
    known = ~np.isnan(column)
    times, column = times[known], column[known]
    if not len(times) or not len(wanted):
        return np.full(len(wanted), np.nan)
    # Seconds since the start are exact in a float64; microseconds since the epoch are too, but only just.
    first = times[0]
    values = np.unwrap(column) if angle else column
    made: Column = np.interp(wanted - first, times - first, values, left=np.nan, right=np.nan)
    if len(times) > 1:
        after = np.clip(np.searchsorted(times, wanted), 1, len(times) - 1)
        between = (times[after] != wanted) & (times[after - 1] != wanted)
        made[between & (times[after] - times[after - 1] > pause)] = np.nan
    if angle:
        made = (made + np.pi) % (2 * np.pi) - np.pi
    return made


# Derived quantities of a drive, and its windows.

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
        seconds = (samples.times_us - samples.times_us[0]) / 1e6
        made["distance_m"] = summed(seconds, np.abs(speed), pause_us(samples.times_us) / 1e6)
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


def build(
    key: DriveKey,
    streams: Mapping[str, Block],
    vehicle: Vehicle | None = None,
    known: Mapping[str, float] | None = None,
) -> Drive:
    """Build a drive from the samples of each stream, in any state."""
    raw = {name: ordered(block) for name, block in sorted(streams.items()) if len(block.times_us)}
    numbers = {name: with_position(numeric(block)) for name, block in raw.items()}
    names = {name: block.columns.keys() for name, block in numbers.items()}
    is_moving = _Moving(numbers, motion_among(names))
    cleaned: dict[str, Block] = {}
    repairs: list[Repair] = []
    for name, block in numbers.items():
        cleaned[name], repaired = clean(name, block, is_moving)
        repairs += repaired
    vesc = vesc_of(names)
    samples = on_one_clock(cleaned, vesc)
    return Drive(
        key=key,
        end_us=max((int(block.times_us[-1]) for block in raw.values()), default=key.start_us),
        streams=cleaned,
        samples=samples if vesc is None else with_derived(samples, vesc, vehicle),
        vesc=vesc,
        pose=pose_of(cleaned),
        vehicle=vehicle,
        known=dict(known or {}),
        raw=raw,
        repairs=repairs,
    )


class _Moving:
    """Whether the car moves at some times, by the stream that tells; never, if none does."""

    def __init__(self, streams: Mapping[str, Block], motion: Motion | None) -> None:
        block = None if motion is None else streams[motion.stream]
        self._moves = None if motion is None or block is None else motion.moves(block.columns)
        self._times = None if block is None else block.times_us

    def __call__(self, times: NDArray[np.int64]) -> NDArray[np.bool_]:
        if self._moves is None or self._times is None:
            return np.zeros(len(times), dtype=np.bool_)
        places = np.clip(np.searchsorted(self._times, times, side="right") - 1, 0, len(self._times) - 1)
        found: NDArray[np.bool_] = self._moves[places]
        return found
