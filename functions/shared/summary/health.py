"""The metrics ``health`` of the cars, from the batches that Lambda 2 reads anyway."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import chain

from functions.shared.metrics import MOST_VALUES
from iort_contract.catalog.streams import AGENT_STREAM, RTT_FIELDS, RTT_STREAM
from iort_contract.catalog.vesc import FAULT_FIELD, TEMPERATURES, VOLTAGE_FIELD, measured_degc
from iort_contract.messages.batch import Batch
from iort_contract.statistics import count_holes, numbers_of
from iort_contract.topics import PING_PATHS

Measured = Mapping[str, float | list[float]]


def measure(stream: str, batches: Sequence[Batch]) -> Measured:
    """The metrics of one robot's batches of one stream; each batch counts once, however many seconds it has.

    Battery (V) and temperature (degC) are the worst of the batches; gaps between samples are counted within
    each batch.
    """
    if stream == RTT_STREAM:
        return {f"RoundTrip{path.capitalize()}Ms": _numbers(batches, RTT_FIELDS[path]) for path in PING_PATHS}
    if stream == AGENT_STREAM:
        backlog = _numbers(batches, "backlog_batches")
        return {
            "AgentReports": sum(len(batch.times_us) for batch in batches),
            "BacklogBatches": backlog[-1:],
            "ThreadErrors": sum(_numbers(batches, "thread_errors")),
        }
    volts = [value for value in _numbers(batches, VOLTAGE_FIELD) if value > 0]
    # A temperature has few different values.
    found = (measured_degc(name, value) for name in TEMPERATURES for value in set(_numbers(batches, name)))
    degc = [value for value in found if value is not None]
    return {
        "SampleGaps": sum(count_holes(batch.times_us) for batch in batches),
        "FaultSamples": sum(map(bool, _numbers(batches, FAULT_FIELD))),
        "BatteryVolts": [min(volts)] if volts else [],
        "TemperatureDegC": [max(degc)] if degc else [],
    }


def together(measured: Iterable[Measured]) -> Iterator[Measured]:
    """Merge the metrics of several robots into as few log lines as possible: counts are added, values are
    listed."""
    counts: dict[str, float] = {}
    values: dict[str, list[float]] = {}
    for one in measured:
        for name, value in one.items():
            if isinstance(value, list):
                values.setdefault(name, []).extend(value)
            else:
                counts[name] = counts.get(name, 0) + value
    yield {**counts, **{name: found[:MOST_VALUES] for name, found in values.items()}}
    for start in range(MOST_VALUES, max(map(len, values.values()), default=0), MOST_VALUES):
        yield {name: found[start : start + MOST_VALUES] for name, found in values.items()}


def _numbers(batches: Iterable[Batch], name: str) -> list[int | float]:
    columns = (batch.columns.get(name, ()) for batch in batches)
    return list(chain.from_iterable(map(numbers_of, columns)))
