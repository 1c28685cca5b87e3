"""The telemetry table's stream: retries, splits, partial answers, and the way into the quarantine."""

from __future__ import annotations

import base64
import json
import time
from collections.abc import Callable, Mapping
from typing import Any

from iort_contract.catalog.vesc import VESC_STREAM
from iort_contract.topics import RECORD, rule_name
from iort_station.data.recorded import summary_table
from iort_station.fleet import control
from iort_station.operations import audit
from iort_station.operations.quarantine import replay
from testkit.waiting import until
from testkit.worst_case import worst_batches
from verify.lab import Lab, batch, batch_number
from verify.question import Seen, question

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


def _published(lab: Lab, base: str) -> str:
    """The name of a new robot, whose batches are in the table, and so in the stream."""
    return lab.driven(base, int(time.time() - _COUNT) * 1_000_000, _COUNT).robot


def _reader(lab: Lab, robot: str, name: str, then: str) -> Callable[[], list[Mapping[str, Any]]]:
    """A second reader of the stream for this robot's batches only, with the settings of Lambda 2's mapping
    except for fewer attempts; returns its events so far, by its lines in Lambda 2's log. It reads from the
    oldest record, so that all batches come at once."""
    client, summarize = lab.client("lambda"), lab.cloud.output("processing", "SummarizeFunction")
    (model,) = client.list_event_source_mappings(FunctionName=summarize)["EventSourceMappings"]
    pattern = {"dynamodb": {"Keys": {"topic": {"S": [lab.topic(RECORD, robot)]}}}}
    same = ("EventSourceArn", "BisectBatchOnFunctionError", "FunctionResponseTypes", "DestinationConfig")
    source, began_ms = _READER % {"said": _SAID, "then": then.strip()}, int(time.time() * 1000)
    mapping = client.create_event_source_mapping(
        FunctionName=lab.function(name, source, memory_mb=128, like="Summarize"),
        StartingPosition="TRIM_HORIZON",
        BatchSize=100,
        MaximumBatchingWindowInSeconds=5,
        MaximumRetryAttempts=1,
        FilterCriteria={"Filters": [{"Pattern": json.dumps(pattern)}]},
        **{key: model[key] for key in same},
    )
    lab.undo(client.delete_event_source_mapping, UUID=mapping["UUID"])
    return lambda: [
        json.loads(line[len(_SAID) :]) for line in lab.lines(summarize, began_ms) if line.startswith(_SAID)
    ]


@question(
    "stream.bisected",
    aws="lambda:services-dynamodb-errors",
    expected={
        "given_up": [_POISONED],
        "reasons": ["Lambda 2 failed: RetryAttemptsExhausted"],
        "passed_in_order": [number for number in range(_COUNT) if number != _POISONED],
        "fields": [
            *("ApproximateCreationDateTime", "Keys", "NewImage"),
            *("SequenceNumber", "SizeBytes", "StreamViewType"),
        ],
        "replayed": ["replayed"],
        "left": 0,
    },
)
def bisected(lab: Lab) -> Seen:
    """If the function fails on a batch of the stream, the batch is split until the poisoned record is
    alone. After the retries, that record is reported to the mapping's destination, by its place in the
    stream, where it is read again. The others pass, in order. A record has these fields, and replay puts it
    back."""
    robot = _published(lab, "verify-bisected")
    events = _reader(lab, robot, "failing", _FAIL)

    def passed() -> list[int] | None:
        """The batches of the successful events, once all but one have passed."""
        good = [event["numbers"] for event in events() if _POISONED not in event["numbers"]]
        numbers = list(dict.fromkeys(number for event in good for number in event))
        return numbers if len(numbers) == _COUNT - 1 else None

    until(lambda: lab.entries(robot), "the poisoned batch in the quarantine", within_s=_WITHIN_S)
    good, seen = until(passed, "the batches around the poisoned one", within_s=_WITHIN_S), events()
    given_up = lab.entries(robot)
    outcomes = list(replay(lab.cloud, given_up))
    return {
        "given_up": [batch_number(entry) for entry in given_up],
        "reasons": [entry.reason for entry in given_up],
        "passed_in_order": good,
        "fields": sorted({name for event in seen for name in event["fields"]}),
        "replayed": [outcome.fate.value for outcome in outcomes],
        "left": len(lab.entries(robot)),
        "note_events": [event["numbers"] for event in seen],
    }


@question(
    "stream.put_off",
    aws="lambda:with-sqs sqs:sqs-fair-queues",
    expected={"told": True, "stored": _EXPENSIVE, "summarised": _EXPENSIVE},
)
def put_off(lab: Lab) -> Seen:
    """Expensive batches of a robot that is over its share of Lambda 2 wait in a queue of their own, in the
    robot's group. The function later summarises them all, and the robot is told in its shadow."""
    bundle = lab.robot("verify-put-off")
    lab.send(bundle, *worst_batches(_EXPENSIVE, first_us=int(time.time() - _EXPENSIVE) * 1_000_000))
    over = until(lambda: control.over_share(lab.cloud, bundle.robot), "the notice in the robot's shadow")

    def seconds() -> int:
        return sum(
            len(page.items) for page in summary_table(lab.cloud).pages(lab.topic(RECORD, bundle.robot))
        )

    until(lambda: seconds() == _EXPENSIVE, "the seconds of batches that were put off", within_s=600)
    return {"told": over.batches > 0, "stored": len(lab.items(bundle.robot)), "summarised": seconds()}


@question(
    "stream.reported",
    aws="lambda:services-ddb-batchfailurereporting",
    expected={"times_reported": 1, "comes_next": [_REPORTED], "again_before_it": [], "in_quarantine": 0},
)
def reported(lab: Lab) -> Seen:
    """If the function's answer names a record in batchItemFailures, the records before it are done, and the
    next event begins with it."""
    robot = _published(lab, "verify-reported")
    reader = _reader(lab, robot, "reporting", _REPORT)

    def ended() -> list[list[int]] | None:
        """The events up to the one that ends the batch without a failure."""
        events = [list(event["numbers"]) for event in reader()]
        whole = any(_REPORTED not in event[1:] and event[-1] == _COUNT - 1 for event in events)
        return events if whole else None

    events = until(ended, "the rest of the batch", within_s=_WITHIN_S)
    reporting = [i for i, event in enumerate(events) if _REPORTED in event[1:]]
    seen = [number for event in events for number in event]
    return {
        "times_reported": len(reporting),
        "comes_next": [events[i + 1][0] for i in reporting],
        "again_before_it": [number for number in range(_REPORTED) if seen.count(number) > 1],
        "in_quarantine": len(lab.entries(robot)),
        "note_events": events,
    }


def _summarized(lab: Lab, robot: str) -> int:
    return audit.samples_summarized(lab.cloud, robot, VESC_STREAM)


@question(
    "quarantine.refused_batch",
    expected={
        "summarized": 2,
        "refused": 1,
        "source": "stream",
        "reason": "samples must be base64 of zlib",
        "seen": 1,
    },
)
def refused_batch(lab: Lab) -> Seen:
    """A batch that Lambda 2 cannot decode goes through the queue into the quarantine's table, with its
    item; the batches before and after it are summarised."""
    bundle = lab.robot("verify-refused")
    lab.send(bundle, batch(0), batch(1, samples="AAAA"), batch(2))
    until(lambda: _summarized(lab, bundle.robot) > 1, "the summaries of the good batches")
    entry = lab.only_entry(bundle.robot)
    return {
        "summarized": _summarized(lab, bundle.robot),
        "refused": batch_number(entry),
        "source": entry.source,
        "reason": entry.reason.split(":")[0],
        "seen": entry.seen,
    }


@question(
    "quarantine.replayed",
    aws="iot:iot-basic-ingest",
    expected={"before": 0, "fate": "replayed", "summarized": 1, "left": 0},
)
def replayed(lab: Lab) -> Seen:
    """A batch in quarantine is published again to its rule alone, by Basic Ingest; it is then in the
    telemetry table, is summarised, and leaves the quarantine."""
    robot = lab.robot("verify-replayed").robot
    # The message of the record rule's error action when the table is throttled.
    document = {
        "ruleName": rule_name("record", lab.namespace),
        "topic": lab.topic(RECORD, robot),
        "base64OriginalPayload": base64.b64encode(batch(0)).decode(),
        "failures": [{"failedAction": "DynamoDBv2Action", "errorMessage": "throttled"}],
    }
    queue = lab.cloud.output("quarantine", "RejectedQueue")
    lab.client("sqs").send_message(QueueUrl=queue, MessageBody=json.dumps(document))
    entry, before = lab.only_entry(robot), _summarized(lab, robot)
    (outcome,) = replay(lab.cloud, [entry])
    until(lambda: _summarized(lab, robot), "the summary of the batch")
    return {
        "before": before,
        "fate": outcome.fate.value,
        "summarized": _summarized(lab, robot),
        "left": len(lab.entries(robot)),
    }
