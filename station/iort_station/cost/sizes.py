"""How large the messages and items of a drive are: measured, by encoding a simulated drive."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from decimal import Decimal
from functools import cache
from typing import Any

from iort_agent.sources.vehicle import Vehicle, VehicleConfig
from iort_contract import (
    AGENT_FIELDS,
    EXPIRES_S,
    RECEIVED_MS,
    RECORD,
    RTT_FIELDS,
    SECOND,
    TOPIC,
    VESC_STREAM,
    Batch,
    LiveSample,
    Value,
    build_topic,
    encode,
    encode_live,
    encode_ping,
    live_update,
    record_topic,
)
from iort_contract.statistics import Vehicle as Gain
from iort_contract.statistics import summarize_second

_BOOT, _ROBOT = "0badcafe0badcafe", "car-0001"
_T_US, _MS = 1_750_000_000_000_000, 1_750_000_000_000
# A drive is looked at when the car is warm and its counters have grown.
_WARM_S = 60


@dataclass(frozen=True)
class Sizes:
    """Bytes. Messages count their topic in, as AWS meters them; items count names and values."""

    record: int
    live: int
    ping: int
    telemetry_item: int
    summary_item: int
    update: int
    sample: int
    sample_item: int


@cache
def measure(rate_hz: float, batch_s: float) -> Sizes:
    """The sizes of a VESC's stream at this rate, in batches of this length; ``sample`` is one flat JSON."""
    samples = _drive(rate_hz, max(1, round(rate_hz * batch_s)))
    first = samples[0]
    message = encode(_batch(samples, rate_hz))
    live = LiveSample(_BOOT, 100_000, _T_US, _T_US + 500, first)
    flat = {"boot": _BOOT, "seq": 100_000, "t": _T_US, **first}
    second = _drive(rate_hz, max(1, round(rate_hz)))
    return Sizes(
        record=len(message) + len(record_topic(_ROBOT, VESC_STREAM)),
        live=len(encode_live(live)) + len(build_topic("live", _ROBOT, VESC_STREAM)),
        ping=len(encode_ping(100_000, _T_US)) + len(build_topic("ping", _ROBOT, "lambda")),
        telemetry_item=stored_bytes(message),
        summary_item=item_bytes(_summary(_batch(second, rate_hz))),
        update=len(json.dumps(live_update(_ROBOT, VESC_STREAM, live, _MS, _T_US), separators=(",", ":"))),
        sample=len(json.dumps(flat, separators=(",", ":"))) + len(build_topic(RECORD, _ROBOT, VESC_STREAM)),
        sample_item=item_bytes({**flat, **_rule()}),
    )


@cache
def own_item_bytes(stream: str, samples: int) -> int:
    """The telemetry item of one of the agent's own streams, ``rtt`` or ``agent``."""
    names = list(AGENT_FIELDS) if stream == "agent" else list(RTT_FIELDS.values())
    columns = {name: [12.345 + 1.37 * i for i in range(samples)] for name in names}
    times = [_T_US + i * 1000 for i in range(samples)]
    return stored_bytes(encode(Batch(_BOOT, 100_000, times, columns)))


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


def _drive(rate_hz: float, count: int) -> list[Mapping[str, Value]]:
    vehicle = Vehicle(VehicleConfig(), seed=1)
    for _ in range(round(_WARM_S * 50)):
        vehicle.step(0.02)
    samples: list[Mapping[str, Value]] = []
    for _ in range(count):
        vehicle.step(min(0.02, 1 / rate_hz))
        samples.append(vehicle.sample())
    return samples


def _batch(samples: Sequence[Mapping[str, Value]], rate_hz: float) -> Batch:
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
