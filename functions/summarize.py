"""Lambda 2: reads batches from the telemetry table's stream, and writes one item a second to the summary
table.

Batches of a robot over its share are put off to `functions.later`.
"""

from __future__ import annotations

import time
from functools import cache
from typing import Any

import boto3
from botocore.config import Config

from functions.shared import clients
from functions.shared.environment import variables
from functions.shared.summary.processing import Bounds, processed, recompute, stored_tables
from functions.shared.summary.share import PutOff, Share, Told
from functions.shared.summary.volume import Volume
from iort_contract.catalog.environments import SummarizeEnvironment
from iort_contract.tables import RECOMPUTE_FROM_S, REPLAY


# Most environments never put anything off, and need no client for it.
@cache
def _bounds() -> Bounds:
    return Bounds(Share(), lambda changes: _put_off().put(changes), lambda *said: _told().tell(*said))


@cache
def _volume() -> Volume:
    given = variables(SummarizeEnvironment)
    return Volume(clients.dynamodb(), given.robots_table, given.record_bytes_a_day)


@cache
def _put_off() -> PutOff:
    return PutOff(clients.sqs(), variables(SummarizeEnvironment).put_off_queue)


@cache
def _told() -> Told:
    # No robot's summary waits for an unavailable service.
    config = Config(connect_timeout=1, read_timeout=2, retries={"total_max_attempts": 1})
    return Told(boto3.client("iot-data", config=config))


def handler(event: dict[str, Any], _context: object) -> dict[str, Any]:
    """Entry point of the telemetry table's stream mapping, and of the operator's replays."""
    if RECOMPUTE_FROM_S in event:
        return recompute(event, stored_tables())
    if event.get(REPLAY):
        # The operator's replays are not charged to a robot, and the stream continues meanwhile.
        return processed(event, beside_others=True)
    answer = processed(event, bounds=_bounds())
    left = {one["itemIdentifier"] for one in answer["batchItemFailures"]}
    changes = (record["dynamodb"] for record in event["Records"])
    _volume().note((one for one in changes if one["SequenceNumber"] not in left), time.time())
    return answer
