"""The events with which the bench invokes functions: as the table's stream and the live rule send them."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Any

from iort_agent.sources.sim import Sensors
from iort_agent.sources.sim.vehicle import Vehicle, VehicleConfig
from iort_contract.messages.envelope import rule_event
from iort_contract.messages.live import LiveSample, encode_live
from iort_contract.tables import BATCH, TOPIC

# Time enough that a robot's share of Lambda 2 is whole again.
_ARRIVES_EVERY_S = 10


def stream_event(items: Sequence[dict[str, Any]], number: int = 0) -> dict[str, Any]:
    """Stored batches as the telemetry table's stream brings them. The events of a drive arrive one after the
    other, by their ``number``, so that no robot is over its share."""
    records = [
        {
            "eventID": f"bench-{i}",
            "eventName": "INSERT",
            "eventSource": "aws:dynamodb",
            "dynamodb": {
                "ApproximateCreationDateTime": int(time.time()) + number * _ARRIVES_EVERY_S,
                "Keys": {name: item[name] for name in (TOPIC, BATCH)},
                "NewImage": item,
                "SequenceNumber": f"{i + 1:021}",
                "StreamViewType": "NEW_IMAGE",
            },
        }
        for i, item in enumerate(items)
    ]
    return {"Records": records}


def live_event(topic: str, number: int) -> dict[str, Any]:
    """A live message of a VESC, as the live rule sends it to Lambda 1."""
    now_us = time.time_ns() // 1000
    sample = Sensors(Vehicle(VehicleConfig(), seed=1), seed=1).vesc()
    message = encode_live(LiveSample("0badcafe", number, now_us - 1000, now_us, sample))
    return rule_event(message, topic, now_us // 1000)
