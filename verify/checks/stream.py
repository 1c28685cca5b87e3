"""The telemetry table's stream under a Lambda mapping: records, retries, splits, partial answers."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

from bench.target import Target
from bench.temporary_function import temporary_function
from iort_contract.catalog.vesc import VESC_STREAM
from iort_contract.messages.batch import Batch, batch_id, encode_batch
from iort_contract.tables import BATCH
from iort_contract.topics import RECORD, build_topic, record_topic
from iort_station.operations import quarantine
from iort_station.operations.replay import replay
from verify.assumption import Basis
from verify.check import Check
from verify.robot import Robot
from verify.waiting import until

_GUIDE = "https://docs.aws.amazon.com/lambda/latest/dg"
_RUN = "0badcafe"
_COUNT, _POISONED, _REPORTED = 5, 2, 3
_WITHIN_S = 170.0
_SAID = "verify: "
# Logs the numbers of its batches, and treats them as the check wants.
_READER = """
import json

def handler(event, context):
    records = [record["dynamodb"] for record in event["Records"]]
    numbers = [int(record["NewImage"]["batch"]["S"].rsplit("-", 1)[1]) for record in records]
    fields = sorted({name for record in records for name in record})
    print("%(said)s" + json.dumps({"numbers": numbers, "fields": fields}), flush=True)
    %(then)s
"""
_FAIL = f"""
    if {_POISONED} in numbers:
        raise ValueError("poisoned")
"""
# Only if older records are in the event: the next event then begins with it.
_REPORT = f"""
    if {_REPORTED} in numbers[1:]:
        number = records[numbers.index({_REPORTED})]["SequenceNumber"]
        return {{"batchItemFailures": [{{"itemIdentifier": number}}]}}
"""


def _published(target: Target, base: str) -> str:
    """The name of a new robot, whose batches are in the table, and so in the stream."""
    bundle, cloud = target.robot(base), target.cloud
    first_us = int(time.time() - _COUNT) * 1_000_000
    with Robot(bundle.folder) as robot:
        robot.online()
        for number in range(_COUNT):
            batch = Batch(_RUN, number, [first_us + number * 1_000_000], {"speed": [1.5]})
            robot.publish(record_topic(robot.name, VESC_STREAM, cloud.namespace), encode_batch(batch))
    query = {
        "TableName": cloud.output("storage", "TelemetryTable"),
        "KeyConditionExpression": "#topic = :topic",
        "ExpressionAttributeNames": {"#topic": "topic"},
        "ExpressionAttributeValues": {":topic": {"S": _topic(target, bundle.robot)}},
        "Select": "COUNT",
    }
    dynamodb = cloud.client("dynamodb")
    until(lambda: dynamodb.query(**query)["Count"] == _COUNT, "the batches in the telemetry table")
    return bundle.robot


def _topic(target: Target, robot: str) -> str:
    return build_topic(RECORD, robot, VESC_STREAM, target.cloud.namespace)


@contextmanager
def _read(target: Target, robot: str, name: str, then: str) -> Iterator[_Said]:
    """A second reader of the stream for this robot's batches only, with the settings of Lambda 2's mapping
    except for fewer attempts. It reads from the oldest record, so that all batches come at once."""
    client, cloud = target.cloud.client("lambda"), target.cloud
    summarize = cloud.output("processing", "SummarizeFunction")
    (mapping,) = client.list_event_source_mappings(FunctionName=summarize)["EventSourceMappings"]
    pattern = {"dynamodb": {"Keys": {"topic": {"S": [_topic(target, robot)]}}}}
    source = _READER % {"said": _SAID, "then": then.strip()}
    began_ms = int(time.time() * 1000)
    with temporary_function(target, name, source, memory_mb=128, like="Summarize") as function:
        made = client.create_event_source_mapping(
            FunctionName=function,
            EventSourceArn=mapping["EventSourceArn"],
            StartingPosition="TRIM_HORIZON",
            BatchSize=100,
            MaximumBatchingWindowInSeconds=5,
            BisectBatchOnFunctionError=mapping["BisectBatchOnFunctionError"],
            FunctionResponseTypes=mapping["FunctionResponseTypes"],
            DestinationConfig=mapping["DestinationConfig"],
            MaximumRetryAttempts=1,
            FilterCriteria={"Filters": [{"Pattern": json.dumps(pattern)}]},
        )
        try:
            yield _Said(target, summarize, began_ms)
        finally:
            client.delete_event_source_mapping(UUID=made["UUID"])


class _Said:
    """The reader's lines in Lambda 2's log."""

    def __init__(self, target: Target, like: str, began_ms: int) -> None:
        configuration = target.cloud.client("lambda").get_function_configuration(FunctionName=like)
        self._group, self._began_ms = configuration["LoggingConfig"]["LogGroup"], began_ms
        self._logs = target.cloud.client("logs")

    def events(self) -> list[Mapping[str, Any]]:
        """Its events, in order."""
        pages = self._logs.get_paginator("filter_log_events").paginate(
            logGroupName=self._group, startTime=self._began_ms
        )
        lines = [event["message"].strip() for page in pages for event in page["events"]]
        return [json.loads(line[len(_SAID) :]) for line in lines if line.startswith(_SAID)]


def _bisected(target: Target) -> dict[str, Any]:
    robot, cloud = _published(target, "verify-bisected"), target.cloud
    with _read(target, robot, "failing", _FAIL) as said:

        def passed() -> list[int] | None:
            """The batches of the successful events, once all but one have passed."""
            good = [event["numbers"] for event in said.events() if _POISONED not in event["numbers"]]
            numbers = list(dict.fromkeys(number for event in good for number in event))
            return numbers if len(numbers) == _COUNT - 1 else None

        listed = until(
            lambda: list(quarantine.entries(cloud, robot=robot)),
            "the poisoned batch in the quarantine",
            within_s=_WITHIN_S,
        )
        good = until(passed, "the batches around the poisoned one", within_s=_WITHIN_S)
        events = said.events()
    entries = [entry for one in listed if (entry := quarantine.load(cloud, one))]
    outcomes = list(replay(cloud, listed))
    return {
        "given_up": [batch_id(json.loads(entry.payload or b"{}")[BATCH]["S"]).seq for entry in entries],
        "reasons": [entry.reason for entry in entries],
        "passed_in_order": good,
        "fields": sorted({name for event in events for name in event["fields"]}),
        "replayed": [outcome.fate.value for outcome in outcomes],
        "left": len(list(quarantine.entries(cloud, robot=robot))),
        "note_events": [event["numbers"] for event in events],
    }


def _reported(target: Target) -> dict[str, Any]:
    robot = _published(target, "verify-reported")
    with _read(target, robot, "reporting", _REPORT) as said:

        def whole() -> list[list[int]] | None:
            """The events up to the one that ends the batch without a failure."""
            events = [list(event["numbers"]) for event in said.events()]
            return (
                events
                if any(_REPORTED not in event[1:] and event[-1] == _COUNT - 1 for event in events)
                else None
            )

        events = until(whole, "the rest of the batch", within_s=_WITHIN_S)
    reporting = [i for i, event in enumerate(events) if _REPORTED in event[1:]]
    seen = [number for event in events for number in event]
    return {
        "times_reported": len(reporting),
        "comes_next": [events[i + 1][0] for i in reporting],
        "again_before_it": [number for number in range(_REPORTED) if seen.count(number) > 1],
        "in_quarantine": len(list(quarantine.entries(target.cloud, robot=robot))),
        "note_events": events,
    }


CHECKS = (
    Check(
        name="stream.bisected",
        assumed=(
            "If the function fails on a batch of the stream, the batch is split until the poisoned record is "
            "alone. After the retries, that record is reported to the mapping's destination, by its place in "
            "the stream, where it is read again. The others pass, in order. A record has these fields, and "
            "replay puts it back."
        ),
        expected={
            "given_up": [_POISONED],
            "reasons": ["Lambda 2 failed: RetryAttemptsExhausted"],
            "passed_in_order": [number for number in range(_COUNT) if number != _POISONED],
            "fields": [
                "ApproximateCreationDateTime",
                "Keys",
                "NewImage",
                "SequenceNumber",
                "SizeBytes",
                "StreamViewType",
            ],
            "replayed": ["replayed"],
            "left": 0,
        },
        basis=Basis.DOCUMENTED,
        source=f"{_GUIDE}/services-dynamodb-errors.html",
        relied_on_by=(
            "stacks/processing.py",
            "functions/quarantine.py",
            "local/gaps/parts/stream_mapping.py",
        ),
        ask=_bisected,
    ),
    Check(
        name="stream.reported",
        assumed=(
            "If the function's answer names a record in batchItemFailures, the records before it are "
            "done, and the next event begins with it."
        ),
        expected={
            "times_reported": 1,
            "comes_next": [_REPORTED],
            "again_before_it": [],
            "in_quarantine": 0,
        },
        basis=Basis.DOCUMENTED,
        source=f"{_GUIDE}/services-ddb-batchfailurereporting.html",
        relied_on_by=("functions/summarize.py", "stacks/processing.py", "local/gaps/parts/stream_mapping.py"),
        ask=_reported,
    ),
)
