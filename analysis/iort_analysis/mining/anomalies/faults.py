"""Faults that the motor controller reports itself."""

from __future__ import annotations

import numpy as np

from iort_analysis.drives.drive import Drive
from iort_analysis.results import Event, Mined
from iort_contract.catalog.vesc import FAULT_FIELD, FAULTS
from iort_contract.messages.analysis import Estimate

KIND = "fault_reported"


def mine_faults(drive: Drive) -> Mined:
    """An event for each code, over the longest time that it was reported without a break."""
    block = drive.raw.get(drive.vesc or "")
    column = None if block is None else block.columns.get(FAULT_FIELD)
    if block is None or column is None or column.dtype.kind != "f":
        return Mined()
    codes = np.nan_to_num(column)
    events = []
    for code in np.unique(codes[codes != 0]).tolist():
        edges = np.flatnonzero(np.diff(np.concatenate([[False], codes == code, [False]]).astype(np.int8)))
        starts, ends = block.times_us[edges[::2]], block.times_us[edges[1::2] - 1]
        longest = int(np.argmax(ends - starts))
        count = float(len(starts))
        text = f"fault {code:.0f}, {FAULTS.get(int(code), 'unknown')}: reported {_times(len(starts))}"
        effect = Estimate(count, count, count, "1")
        start_us, end_us = int(starts[longest]), int(ends[longest])
        events.append(Event(KIND, start_us, end_us, drive.vesc or "", (FAULT_FIELD,), text, effect))
    return Mined(events=events)


def _times(count: int) -> str:
    return "once" if count == 1 else f"{count} times"
