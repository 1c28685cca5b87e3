"""A drive from its streams as recorded: cleaned, on one clock, with derived quantities."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from iort_analysis.drives.cleaning import clean, numeric
from iort_analysis.drives.clock import on_one_clock
from iort_analysis.drives.drive import Drive, Repair
from iort_analysis.drives.motion import Motion, motion_among, pose_of, vesc_of, with_position
from iort_analysis.drives.transform import with_derived
from iort_analysis.samples.blocks import Block, ordered
from iort_contract.catalog.derived import Vehicle
from iort_contract.messages.analysis import DriveKey


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
