"""Stores the batches of a simulated drive directly in the telemetry table, as the record rule does."""

from __future__ import annotations

import json
import time
from collections.abc import Sequence
from typing import Any

from boto3.dynamodb.types import TypeSerializer

from iort_contract.catalog.vesc import VESC_STREAM
from iort_contract.limits import Value
from iort_contract.messages.batch import Batch, encode_batch
from iort_contract.tables import EXPIRES_S, RECEIVED_MS, TOPIC
from iort_contract.topics import RECORD, build_topic
from iort_station.operations import audit
from testkit.car import RATE_HZ, simulated_drive
from testkit.target import Target
from testkit.waiting import until

_KEPT_S = 86_400
_CATCH_UP_S = 120.0
Sample = tuple[int, dict[str, Value]]


def simulated(points: int, stream: str = VESC_STREAM) -> list[Sample]:
    """Return the time in microseconds and the fields of every sample of a drive that ended a minute ago."""
    first_us = (int(time.time()) - points // RATE_HZ - 60) * 1_000_000
    times = (first_us + i * 1_000_000 // RATE_HZ for i in range(points))
    return list(zip(times, simulated_drive(points, stream=stream), strict=True))


def store(
    target: Target, robot: str, samples: Sequence[Sample], stream: str = VESC_STREAM
) -> list[dict[str, Any]]:
    """Put one batch a second into the table, and wait until Lambda 2 has summarised all; return the items."""
    serialize = TypeSerializer().serialize
    client, table = target.cloud.client("dynamodb"), target.cloud.output("storage", "TelemetryTable")
    topic = build_topic(RECORD, robot, stream, target.cloud.namespace)
    expires_s = int(time.time()) + _KEPT_S
    items = []
    for seq, at in enumerate(range(0, len(samples), RATE_HZ)):
        second = samples[at : at + RATE_HZ]
        columns = {name: [sample[name] for _, sample in second] for name in second[0][1]}
        item = json.loads(encode_batch(Batch("0badcafe", seq, [t_us for t_us, _ in second], columns)))
        item |= {TOPIC: topic, RECEIVED_MS: second[-1][0] // 1000, EXPIRES_S: expires_s}
        items.append({name: serialize(value) for name, value in item.items()})
        client.put_item(TableName=table, Item=items[-1])
    until(
        lambda: audit.samples_summarized(target.cloud, robot, stream) >= len(samples),
        "Lambda 2 to summarise what was stored",
        _CATCH_UP_S,
    )
    return items
