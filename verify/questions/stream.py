"""The telemetry table's stream: retries, splits, partial answers, and the way into the quarantine."""

from __future__ import annotations

import base64
import json
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any

from iort_contract.catalog.vesc import VESC_STREAM
from iort_contract.messages.batch import batch_id
from iort_contract.tables import BATCH
from iort_contract.topics import rule_name
from iort_station.data.recorded import summary_table
from iort_station.fleet import control
from iort_station.operations import audit
from iort_station.operations.quarantine import replay
from testkit.target import Target, temporary_function
from testkit.waiting import until
from testkit.worst_case import worst_batches
from verify.question import Seen, question
from verify.tools import batch, entries, items, lines, listed, only_entry, send, topic

_GUIDE = "https://docs.aws.amazon.com/lambda/latest/dg"
# So many at once are beyond a robot's share on every machine.
_EXPENSIVE = 20
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
    bundle, first_us = target.robot(base), int(time.time() - _COUNT) * 1_000_000
    send(target, bundle, *(batch(number, first_us=first_us) for number in range(_COUNT)))
    until(lambda: len(items(target, bundle.robot)) == _COUNT, "the batches in the telemetry table")
    return bundle.robot


@contextmanager
def _read(
    target: Target, robot: str, name: str, then: str
) -> Iterator[Callable[[], list[Mapping[str, Any]]]]:
    """A second reader of the stream for this robot's batches only, with the settings of Lambda 2's mapping
    except for fewer attempts. It reads from the oldest record, so that all batches come at once."""
    client, cloud = target.cloud.client("lambda"), target.cloud
    summarize = cloud.output("processing", "SummarizeFunction")
    (mapping,) = client.list_event_source_mappings(FunctionName=summarize)["EventSourceMappings"]
    pattern = {"dynamodb": {"Keys": {"topic": {"S": [topic(target, robot)]}}}}
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
            yield lambda: _said(target, summarize, began_ms)
        finally:
            client.delete_event_source_mapping(UUID=made["UUID"])


def _said(target: Target, like: str, began_ms: int) -> list[Mapping[str, Any]]:
    """The reader's events, in order, by its lines in Lambda 2's log."""
    return [
        json.loads(line[len(_SAID) :]) for line in lines(target, like, began_ms) if line.startswith(_SAID)
    ]


@question(
    "stream.bisected",
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
    source=f"{_GUIDE}/services-dynamodb-errors.html",
    relied_on_by=("stacks/processing.py", "functions/quarantine.py", "local/emulator/fixes/stream_model.py"),
)
def bisected(target: Target) -> Seen:
    """If the function fails on a batch of the stream, the batch is split until the poisoned record is
    alone. After the retries, that record is reported to the mapping's destination, by its place in the
    stream, where it is read again. The others pass, in order. A record has these fields, and replay puts it
    back."""
    robot = _published(target, "verify-bisected")
    with _read(target, robot, "failing", _FAIL) as said:

        def passed() -> list[int] | None:
            """The batches of the successful events, once all but one have passed."""
            good = [event["numbers"] for event in said() if _POISONED not in event["numbers"]]
            numbers = list(dict.fromkeys(number for event in good for number in event))
            return numbers if len(numbers) == _COUNT - 1 else None

        until(lambda: listed(target, robot), "the poisoned batch in the quarantine", within_s=_WITHIN_S)
        good = until(passed, "the batches around the poisoned one", within_s=_WITHIN_S)
        events = said()
    given_up = entries(target, robot)
    outcomes = list(replay(target.cloud, given_up))
    return {
        "given_up": [batch_id(json.loads(entry.payload or b"{}")[BATCH]["S"]).seq for entry in given_up],
        "reasons": [entry.reason for entry in given_up],
        "passed_in_order": good,
        "fields": sorted({name for event in events for name in event["fields"]}),
        "replayed": [outcome.fate.value for outcome in outcomes],
        "left": len(listed(target, robot)),
        "note_events": [event["numbers"] for event in events],
    }


@question(
    "stream.put_off",
    expected={"told": True, "stored": _EXPENSIVE, "summarised": _EXPENSIVE},
    source=f"{_GUIDE}/with-sqs.html and "
    "https://docs.aws.amazon.com/AWSSimpleQueueService/latest/SQSDeveloperGuide/sqs-fair-queues.html",
    relied_on_by=("functions/later.py", "functions/shared/share.py", "stacks/processing.py"),
)
def put_off(target: Target) -> Seen:
    """Expensive batches of a robot that is over its share of Lambda 2 wait in a queue of their own, in the
    robot's group. The function later summarises them all, and the robot is told in its shadow."""
    bundle, cloud = target.robot("verify-put-off"), target.cloud
    send(target, bundle, *worst_batches(_EXPENSIVE, first_us=int(time.time() - _EXPENSIVE) * 1_000_000))
    over = until(lambda: control.over_share(cloud, bundle.robot), "the notice in the robot's shadow")

    def seconds() -> int:
        pages = summary_table(cloud).pages(topic(target, bundle.robot))
        return sum(len(page.items) for page in pages)

    until(lambda: seconds() == _EXPENSIVE, "the seconds of batches that were put off", within_s=600)
    return {
        "told": over.batches > 0,
        "stored": len(items(target, bundle.robot)),
        "summarised": seconds(),
    }


@question(
    "stream.reported",
    expected={"times_reported": 1, "comes_next": [_REPORTED], "again_before_it": [], "in_quarantine": 0},
    source=f"{_GUIDE}/services-ddb-batchfailurereporting.html",
    relied_on_by=("functions/summarize.py", "stacks/processing.py", "local/emulator/fixes/stream_model.py"),
)
def reported(target: Target) -> Seen:
    """If the function's answer names a record in batchItemFailures, the records before it are done, and the
    next event begins with it."""
    robot = _published(target, "verify-reported")
    with _read(target, robot, "reporting", _REPORT) as said:

        def ended() -> list[list[int]] | None:
            """The events up to the one that ends the batch without a failure."""
            events = [list(event["numbers"]) for event in said()]
            whole = any(_REPORTED not in event[1:] and event[-1] == _COUNT - 1 for event in events)
            return events if whole else None

        events = until(ended, "the rest of the batch", within_s=_WITHIN_S)
    reporting = [i for i, event in enumerate(events) if _REPORTED in event[1:]]
    seen = [number for event in events for number in event]
    return {
        "times_reported": len(reporting),
        "comes_next": [events[i + 1][0] for i in reporting],
        "again_before_it": [number for number in range(_REPORTED) if seen.count(number) > 1],
        "in_quarantine": len(listed(target, robot)),
        "note_events": events,
    }


def _summarized(target: Target, robot: str) -> int:
    return audit.samples_summarized(target.cloud, robot, VESC_STREAM)


@question(
    "quarantine.refused_batch",
    expected={
        "summarized": 2,
        "refused": 1,
        "source": "stream",
        "reason": "samples must be base64 of zlib",
        "seen": 1,
    },
    relied_on_by=("functions/summarize.py", "functions/shared/queues.py", "functions/quarantine.py"),
)
def refused_batch(target: Target) -> Seen:
    """A batch that Lambda 2 cannot decode goes through the queue into the quarantine's table, with its
    item; the batches before and after it are summarised."""
    bundle = target.robot("verify-refused")
    send(target, bundle, batch(0), batch(1, samples="AAAA"), batch(2))
    until(lambda: _summarized(target, bundle.robot) > 1, "the summaries of the good batches")
    entry = only_entry(target, bundle.robot)
    return {
        "summarized": _summarized(target, bundle.robot),
        "refused": batch_id(json.loads(entry.payload or b"{}")[BATCH]["S"]).seq,
        "source": entry.source,
        "reason": entry.reason.split(":")[0],
        "seen": entry.seen,
    }


@question(
    "quarantine.replayed",
    expected={"before": 0, "fate": "replayed", "summarized": 1, "left": 0},
    source="https://docs.aws.amazon.com/iot/latest/developerguide/iot-basic-ingest.html",
    relied_on_by=("station/iort_station/operations/quarantine.py", "functions/quarantine.py"),
)
def replayed(target: Target) -> Seen:
    """A batch in quarantine is published again to its rule alone, by Basic Ingest; it is then in the
    telemetry table, is summarised, and leaves the quarantine."""
    # The message of the record rule's error action when the table is throttled.
    cloud, robot = target.cloud, target.robot("verify-replayed").robot
    document = {
        "ruleName": rule_name("record", cloud.namespace),
        "topic": topic(target, robot),
        "base64OriginalPayload": base64.b64encode(batch(0)).decode(),
        "failures": [{"failedAction": "DynamoDBv2Action", "errorMessage": "throttled"}],
    }
    queue = cloud.output("quarantine", "RejectedQueue")
    cloud.client("sqs").send_message(QueueUrl=queue, MessageBody=json.dumps(document))
    entry, before = only_entry(target, robot), _summarized(target, robot)
    (outcome,) = replay(cloud, [entry])
    until(lambda: _summarized(target, robot), "the summary of the batch")
    return {
        "before": before,
        "fate": outcome.fate.value,
        "summarized": _summarized(target, robot),
        "left": len(listed(target, robot)),
    }
