"""Sensors that are stuck: the cleaning has found where a value stood still while the car moved."""

from __future__ import annotations

from collections.abc import Iterable

from iort_analysis.drives.drive import FROZEN, Drive, Repair
from iort_analysis.results import Event, Mined
from iort_contract.catalog.vesc import VESC_FIELDS
from iort_contract.messages.analysis.findings import Estimate

KIND = "sensor_stuck"
# The units of what a sensor measures; counters and codes may stand still.
_MEASURED = frozenset({"V", "A", "degC", "erpm", "1", "deg"})
# So many fields at once are not their sensors' fault, but that of the link: `gaps` finds it.
_LINK = 6


def mine_frozen(drive: Drive) -> Mined:
    """An event for each sensor that was stuck. Fields that stand still together are one sensor's."""
    frozen = [repair for repair in drive.repairs if repair.kind == FROZEN and _measured(drive, repair)]
    sensors: dict[tuple[str, ...], list[list[Repair]]] = {}
    for together in _together(frozen):
        fields = tuple(repair.field for repair in together)
        if len(fields) < _LINK:
            sensors.setdefault((together[0].stream, *fields), []).append(together)
    return Mined(events=[_event(times) for _, times in sorted(sensors.items())])


def _measured(drive: Drive, repair: Repair) -> bool:
    field = VESC_FIELDS.get(repair.field) if repair.stream == drive.vesc else None
    return field is None or field.unit in _MEASURED


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


def _event(times: list[list[Repair]]) -> Event:
    longest = max((group[0] for group in times), key=lambda repair: repair.end_us - repair.start_us)
    fields = tuple(repair.field for repair in times[0])
    seconds = (longest.end_us - longest.start_us) / 1e6
    text = f"{' and '.join(fields)} kept the same value for {seconds:.0f} s while the car moved"
    if len(times) > 1:
        text += f", the longest of {len(times)} times"
    effect = Estimate(seconds, seconds, seconds, "s")
    return Event(KIND, longest.start_us, longest.end_us, longest.stream, fields, text, effect)
