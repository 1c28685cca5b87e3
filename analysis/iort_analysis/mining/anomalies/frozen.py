"""Sensors that are stuck: the cleaning has found where a value stood still while the car moved."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from iort_analysis.drives.drive import FROZEN, Drive, Repair
from iort_analysis.results import Event, Mined
from iort_contract.messages.analysis import Estimate

KIND = "sensor_stuck"
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
    seconds, step_s = (longest.end_us - longest.start_us) / 1e6, _step_s(drive, longest.stream)
    effect = Estimate(seconds, seconds, seconds + 2 * step_s, "s")
    text = f"the value of {' and '.join(fields)} stayed the same for {seconds:.3g} s while the car moved"
    if len(times) > 1:
        text += f", the longest of {len(times)} times"
    return Event(KIND, longest.start_us, longest.end_us, longest.stream, fields, text, effect)


def _step_s(drive: Drive, stream: str) -> float:
    """The usual time between two samples of a stream."""
    return float(np.median(np.diff(drive.streams[stream].times_us))) / 1e6
