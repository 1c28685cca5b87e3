"""A refused batch on its way to the quarantine, and back."""

from __future__ import annotations

import base64
import json
import time
from typing import Any

from bench.target import Target
from iort_contract.catalog.vesc import VESC_STREAM
from iort_contract.messages.batch import Batch, batch_id, encode_batch
from iort_contract.tables import BATCH
from iort_contract.topics import RECORD, build_topic, record_topic, rule_name
from iort_station.operations import delivery, quarantine
from iort_station.operations.quarantine import DeadLetter
from iort_station.operations.replay import replay
from verify.assumption import Basis
from verify.check import Check
from verify.errors import VerifyError
from verify.robot import Robot
from verify.waiting import until

_RUN = "0badcafe"


def _batch(number: int, **changes: Any) -> bytes:
    """A current batch with one sample, with changes in its envelope."""
    batch = Batch(_RUN, number, [(int(time.time()) - 5 + number) * 1_000_000], {"speed": [1.5]})
    return json.dumps({**json.loads(encode_batch(batch)), **changes}).encode()


def _entry(target: Target, robot: str) -> DeadLetter:
    (listed,) = until(
        lambda: list(quarantine.entries(target.cloud, robot=robot)), "the entry in the quarantine"
    )
    entry = quarantine.load(target.cloud, listed)
    if entry is None:
        raise VerifyError("the entry has gone")
    return entry


def _summarized(target: Target, robot: str) -> int:
    return delivery.samples_summarized(target.cloud, robot, VESC_STREAM)


def _refused(target: Target) -> dict[str, Any]:
    bundle = target.robot("verify-refused")
    with Robot(bundle.folder) as robot:
        robot.online()
        topic = record_topic(robot.name, VESC_STREAM, target.cloud.namespace)
        for message in (_batch(0), _batch(1, samples="AAAA"), _batch(2)):
            robot.publish(topic, message)
    until(lambda: _summarized(target, bundle.robot) > 1, "the summaries of the good batches")
    entry = _entry(target, bundle.robot)
    return {
        "summarized": _summarized(target, bundle.robot),
        "refused": batch_id(json.loads(entry.payload or b"{}")[BATCH]["S"]).seq,
        "source": entry.source,
        "reason": entry.reason.split(":")[0],
        "seen": entry.seen,
    }


def _replayed(target: Target) -> dict[str, Any]:
    """The message of the record rule's error action when the table is throttled."""
    cloud, robot = target.cloud, target.robot("verify-replayed").robot
    document = {
        "ruleName": rule_name("record", cloud.namespace),
        "topic": build_topic(RECORD, robot, VESC_STREAM, cloud.namespace),
        "base64OriginalPayload": base64.b64encode(_batch(0)).decode(),
        "failures": [{"failedAction": "DynamoDBv2Action", "errorMessage": "throttled"}],
    }
    queue = cloud.output("quarantine", "RejectedQueue")
    cloud.client("sqs").send_message(QueueUrl=queue, MessageBody=json.dumps(document))
    entry, before = _entry(target, robot), _summarized(target, robot)
    (outcome,) = replay(cloud, [entry])
    until(lambda: _summarized(target, robot), "the summary of the batch")
    return {
        "before": before,
        "fate": outcome.fate.value,
        "summarized": _summarized(target, robot),
        "left": len(list(quarantine.entries(cloud, robot=robot))),
    }


CHECKS = (
    Check(
        name="quarantine.refused_batch",
        assumed=(
            "A batch that Lambda 2 cannot decode goes through the queue into the quarantine's table, with "
            "its item; the batches before and after it are summarised."
        ),
        expected={
            "summarized": 2,
            "refused": 1,
            "source": "stream",
            "reason": "samples must be base64 of zlib",
            "seen": 1,
        },
        basis=Basis.ASSUMED,
        relied_on_by=("functions/summarize.py", "functions/shared/dead_letter.py", "functions/quarantine.py"),
        ask=_refused,
    ),
    Check(
        name="quarantine.replayed",
        assumed=(
            "A batch in quarantine is published again to its rule alone, by Basic Ingest; it is then in the "
            "telemetry table, is summarised, and leaves the quarantine."
        ),
        expected={"before": 0, "fate": "replayed", "summarized": 1, "left": 0},
        basis=Basis.DOCUMENTED,
        source="https://docs.aws.amazon.com/iot/latest/developerguide/iot-basic-ingest.html",
        relied_on_by=("station/iort_station/operations/replay.py", "functions/quarantine.py"),
        ask=_replayed,
    ),
)
