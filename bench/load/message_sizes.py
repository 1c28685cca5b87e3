"""Measures the sizes of messages and items, by encoding a simulated drive.

    python -m bench.load.message_sizes

prints the constants of station/iort_station/cost/model.py, on which the cost model rests."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from decimal import Decimal
from io import BytesIO
from typing import Any

from boto3.dynamodb.types import TypeSerializer

from iort_agent.sources.sim.vehicle import VehicleConfig
from iort_analysis.archive.writing import write_hour
from iort_contract.archive import hour_of
from iort_contract.catalog.derived import Vehicle as Gain
from iort_contract.catalog.streams import AGENT_FIELDS
from iort_contract.catalog.vesc import VESC_STREAM
from iort_contract.limits import Value
from iort_contract.messages.batch import Batch, encode_batch
from iort_contract.messages.live import LiveSample, live_update
from iort_contract.statistics import summarize_second
from iort_contract.tables import BATCH, EXPIRES_S, RECEIVED_MS, SECOND, TOPIC
from iort_contract.topics import RECORD, build_topic, record_topic
from iort_station.cost.model import Measured
from testkit.car import simulated_drive

_BOOT, _ROBOT = "0badcafe0badcafe", "car-0001"
_T_US, _MS = 1_750_000_000_000_000, 1_750_000_000_000
# After a minute the motor is warm and the counters have grown. Seconds of a lap differ in size by a sixth;
# this is one of a middle size.
_WARM_S = 77


# Rows of the table: samples in a second.
SAMPLES = (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000, 2000)


def main() -> None:
    """Print the constants of station/iort_station/cost/model.py."""
    for samples in SAMPLES:
        print(f"    Measured{tuple(batch_sizes(samples, 1.0))},")
    for name, size in message_sizes().items():
        print(f"{name} = {size}")
    print(f"ARCHIVED_SHARE = {archived_share():.2f}")


def batch_sizes(rate_hz: float, batch_s: float) -> Measured:
    """The sizes of a batch of a VESC's stream, and of the summary of a second at this rate."""
    samples = simulated_drive(max(1, round(rate_hz * batch_s)), rate_hz=rate_hz, after_s=_WARM_S)
    message = encode_batch(batch_of(samples, rate_hz))
    second = batch_of(simulated_drive(max(1, round(rate_hz)), rate_hz=rate_hz, after_s=_WARM_S), rate_hz)
    return Measured(
        samples=len(samples),
        record=len(message) + len(record_topic(_ROBOT, VESC_STREAM)),
        telemetry_item=stored_bytes(message),
        summary_item=item_bytes(_summary(second)),
    )


def message_sizes() -> dict[str, int]:
    """The sizes of messages and items with one sample, by the name of `iort_station.cost.model`."""
    (first,) = simulated_drive(1, after_s=_WARM_S)
    live = LiveSample(_BOOT, 100_000, _T_US, _T_US + 500, first)
    flat = {"boot": _BOOT, "seq": 100_000, "t": _T_US, **first}
    update = json.dumps(live_update(_ROBOT, VESC_STREAM, live, _MS, _T_US), separators=(",", ":"))
    sample = json.dumps(flat, separators=(",", ":"))
    return {
        "UPDATE_BYTES": len(update),
        "OWN_ITEM_BYTES": own_item_bytes(),
        "SAMPLE_BYTES": len(sample) + len(build_topic(RECORD, _ROBOT, VESC_STREAM)),
        "SAMPLE_ITEM_BYTES": item_bytes({**flat, **_rule()}),
    }


def own_item_bytes() -> int:
    """The telemetry item of the agent's own figures, one sample."""
    columns: dict[str, list[Value]] = {name: [12.345] for name in AGENT_FIELDS}
    return stored_bytes(encode_batch(Batch(_BOOT, 100_000, [_T_US], columns)))


def archived_share() -> float:
    """The bytes in the archive for each byte of a drive's items in the table, over a whole hour."""
    samples = simulated_drive(3600 * 50, after_s=_WARM_S)
    items, stored, into, serialize = [], 0, BytesIO(), TypeSerializer().serialize
    start_us = hour_of(_T_US).start_us
    for second in range(3600):
        batch = batch_of(samples[second * 50 : (second + 1) * 50], 50)
        times_us = [t_us - _T_US + start_us + second * 1_000_000 for t_us in batch.times_us]
        made = replace(batch, seq=100_000 + second, times_us=times_us)
        item = {**json.loads(encode_batch(made)), **_rule(), BATCH: str(made.id)}
        stored += item_bytes(item)
        items.append({name: serialize(value) for name, value in item.items()})
    write_hour(items, into, hour=hour_of(start_us), refused=BytesIO(), scratch=BytesIO())
    return len(into.getvalue()) / stored


def stored_bytes(message: bytes) -> int:
    """The item that the record rule makes of a message."""
    return item_bytes({**json.loads(message), **_rule()})


def item_bytes(item: Mapping[str, Any]) -> int:
    """An item's size as DynamoDB counts it ("Item sizes and formats")."""
    return sum(len(name.encode()) + _value_bytes(value) for name, value in item.items())


def _value_bytes(value: Any) -> int:
    if isinstance(value, str):
        return len(value.encode())
    if isinstance(value, (bool, type(None))):
        return 1
    if isinstance(value, list):
        return 3 + sum(1 + _value_bytes(each) for each in value)
    digits = len(Decimal(repr(value)).normalize().as_tuple().digits)
    # Two digits a byte, one for the exponent and one for a minus.
    return (digits + 1) // 2 + 1 + int(value < 0)


def _rule() -> dict[str, Value]:
    topic = build_topic(RECORD, _ROBOT, VESC_STREAM)
    return {TOPIC: topic, RECEIVED_MS: _MS, EXPIRES_S: _MS // 1000}


def batch_of(samples: Sequence[Mapping[str, Value]], rate_hz: float) -> Batch:
    """The samples as a batch of at most a second."""
    # Times jitter as they do on a car: the same step every time would compress to nothing.
    times = [_T_US + round(i * 1e6 / rate_hz) + (i * 7919) % 211 for i in range(len(samples))]
    times = [t for t in times if t - times[0] < 1_000_000]
    columns = {name: [sample[name] for sample in samples[: len(times)]] for name in samples[0]}
    return Batch(_BOOT, 100_000, times, columns)


def _summary(batch: Batch) -> dict[str, Any]:
    """The item that Lambda 2 makes of a second."""
    second = batch.t_us // 1_000_000
    summary = summarize_second(second, [replace(batch, seq=0)], Gain(VehicleConfig().speed_to_erpm_gain))
    return {**(summary or {}), TOPIC: _rule()[TOPIC], SECOND: second, EXPIRES_S: _MS // 1000}


if __name__ == "__main__":
    main()
