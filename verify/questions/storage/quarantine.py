"""A refused batch on its way to the quarantine, and back."""

from __future__ import annotations

import base64
import json

from iort_contract.catalog.vesc import VESC_STREAM
from iort_contract.messages.batch import batch_id
from iort_contract.tables import BATCH
from iort_contract.topics import rule_name
from iort_station.operations import audit
from iort_station.operations.quarantine import replay
from testkit.target import Target
from testkit.waiting import until
from verify.question import Seen, question
from verify.tools.telemetry import batch, listed, only_entry, send, topic


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
