"""The derived fields, and their calculation from columns of values. A new one is an entry of `DERIVED`."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from itertools import repeat
from typing import Any, Callable, Collection, Iterable, Iterator, Mapping, Sequence

from iort_contract.catalog.entries import Derived
from iort_contract.limits import Value
from iort_contract.tables import GAIN_SET_MS

_NUMBERS = {int, float}


@dataclass(frozen=True)
class Vehicle:
    """Parameters that convert a VESC's values to the car's: ``erpm = gain * m/s + offset`` (vesc.yaml)."""

    speed_to_erpm_gain: float
    speed_to_erpm_offset: float = 0.0


# The F1TENTH stack's vesc.yaml.
F1TENTH = Vehicle(speed_to_erpm_gain=4614.0)


def registered_vehicle(row: Mapping[str, Any]) -> Vehicle | None:
    """A car's own parameters, by its row of the registry; the default that nobody has touched is none."""
    gain = float(row.get("speed_to_erpm_gain") or 0.0)
    vehicle = Vehicle(gain, float(row.get("speed_to_erpm_offset") or 0.0))
    return vehicle if gain and (vehicle != F1TENTH or GAIN_SET_MS in row) else None


_PARAMETERS = frozenset(parameter.name for parameter in fields(Vehicle))

DERIVED = {
    entry.name: entry
    for entry in (
        Derived(
            "speed_mps",
            "m/s",
            "speed of the car",
            lambda speed, speed_to_erpm_gain, speed_to_erpm_offset: (
                (speed - speed_to_erpm_offset) / speed_to_erpm_gain
            ),
            label="Speed",
        ),
        Derived(
            "power_w",
            "W",
            "electrical power from the battery, negative while regenerating",
            lambda voltage_input, current_input: voltage_input * current_input,
            label="Battery power",
        ),
    )
}
# The stored fields and the vehicle's parameters that each derived field needs.
SOURCES = {name: tuple(a for a in d.arguments if a not in _PARAMETERS) for name, d in DERIVED.items()}
PARAMETERS = {name: tuple(a for a in d.arguments if a in _PARAMETERS) for name, d in DERIVED.items()}


def calculable(
    columns: Collection[str], vehicle: Vehicle | None
) -> Iterator[tuple[Derived, Mapping[str, float]]]:
    """The derived fields that these columns and the vehicle allow, each with its parameters."""
    known = {} if vehicle is None else vars(vehicle)
    for name, entry in DERIVED.items():
        if all(source in columns for source in SOURCES[name]) and all(
            parameter in known for parameter in PARAMETERS[name]
        ):
            yield entry, {parameter: known[parameter] for parameter in PARAMETERS[name]}


def calculator(name: str, vehicle: Vehicle | None) -> Callable[[Mapping[str, Value]], Value]:
    """What calculates a derived field of one sample, as `derive` does; raises `KeyError` for one that this
    vehicle does not allow. The sample has the field's sources."""
    entry, parameters = next(
        (found for found in calculable(SOURCES[name], vehicle) if found[0].name == name), (None, {})
    )
    if entry is None:
        raise KeyError(name)
    return lambda sample: _one(entry, {source: sample[source] for source in SOURCES[name]}, parameters)


def derive(columns: Mapping[str, Sequence[Value]], vehicle: Vehicle | None) -> dict[str, list[Value]]:
    """The derived columns, one value per sample; null where a source is null or the result is not finite."""
    return {
        entry.name: _calculated(entry, columns, parameters)
        for entry, parameters in calculable(columns, vehicle)
    }


def _calculated(
    entry: Derived, columns: Mapping[str, Sequence[Value]], parameters: Mapping[str, float]
) -> list[Value]:
    sources = [columns[name] for name in SOURCES[entry.name]]
    if all(set(map(type, column)) <= _NUMBERS for column in sources):
        # Nearly every column; all in C, since Lambda 2 does this for every second.
        arguments: list[Iterable[float]] = [
            repeat(parameters[name]) if name in parameters else map(float, columns[name])  # type: ignore[arg-type]  # numbers
            for name in entry.arguments
        ]
        try:
            found: list[Value] = list(map(entry.formula, *arguments))
        except ArithmeticError:
            pass
        else:
            if all(map(math.isfinite, found)):  # type: ignore[arg-type]  # numbers
                return found
    return [_one(entry, dict(zip(SOURCES[entry.name], sample)), parameters) for sample in zip(*sources)]


def _one(entry: Derived, sample: Mapping[str, Value], parameters: Mapping[str, float]) -> Value:
    if not set(map(type, sample.values())) <= _NUMBERS:
        return None
    numbers: Mapping[str, Any] = {name: float(value) for name, value in sample.items()}  # type: ignore[arg-type]  # numbers
    try:
        value: float | None = entry.formula(**numbers, **parameters)
    except ArithmeticError:
        return None
    return value if value is not None and math.isfinite(value) else None
