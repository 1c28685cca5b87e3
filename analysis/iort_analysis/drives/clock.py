"""One clock for all streams: the samples of each at the times of one of them."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from iort_analysis.drives.cleaning import ANGLES, pause_us
from iort_analysis.samples.blocks import EMPTY, Block, Column


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
