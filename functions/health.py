"""How the cars are, from the batches that Lambda 2 sees anyway: the values of the metrics ``health``."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TypeGuard

from contract import (
    AGENT_STREAM,
    FAULT_FIELD,
    PING_PATHS,
    RTT_FIELDS,
    RTT_STREAM,
    VOLTAGE_FIELD,
    Batch,
    Value,
)
from functions.statistics import count_holes

# The controllers' own temperatures; a driver that does not measure one leaves it at 0.
_TEMPERATURES = (
    "temperature_pcb",
    "temp_fet",
    "temp_motor",
    "ntc_temp_mos1",
    "ntc_temp_mos2",
    "ntc_temp_mos3",
)


def measure(stream: str, batches: Sequence[Batch]) -> dict[str, float | list[float]]:
    """The metrics of one robot's batches of one stream; each batch counts once, whatever its seconds.

    Battery (V) and temperature (degC) are the worst of the batches; holes between samples are counted
    within each batch.
    """
    if stream == RTT_STREAM:
        return {
            f"RoundTrip{path.capitalize()}Ms": list(_numbers(batches, RTT_FIELDS[path]))
            for path in PING_PATHS
        }
    if stream == AGENT_STREAM:
        backlog = list(_numbers(batches, "backlog_batches"))
        return {"AgentReports": sum(len(batch.times_us) for batch in batches), "BacklogBatches": backlog[-1:]}
    volts = [value for value in _numbers(batches, VOLTAGE_FIELD) if value > 0]
    hot = [value for name in _TEMPERATURES for value in _numbers(batches, name) if value]
    return {
        "SampleGaps": sum(count_holes(batch.times_us) for batch in batches),
        "FaultSamples": sum(value != 0 for value in _numbers(batches, FAULT_FIELD)),
        "BatteryVolts": [min(volts)] if volts else [],
        "TemperatureDegC": [max(hot)] if hot else [],
    }


def _numbers(batches: Iterable[Batch], name: str) -> Iterable[float]:
    for batch in batches:
        yield from (float(value) for value in batch.columns.get(name, ()) if _is_number(value))


def _is_number(value: Value) -> TypeGuard[int | float]:
    return isinstance(value, (int, float)) and not isinstance(value, bool)
