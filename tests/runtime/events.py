"""An event for each function, as AWS sends it: the smallest one that makes the function do its work."""

from __future__ import annotations

import base64
import hashlib
import json
import time
from typing import Any

from boto3.dynamodb.types import TypeSerializer

from iort_contract.archive import DUE, TASK
from iort_contract.catalog.vesc import VESC_STREAM
from iort_contract.messages.analysis.findings import DriveKey
from iort_contract.messages.analysis.run import PlannedDrive, encode_planned
from iort_contract.messages.batch import Batch, encode_batch
from iort_contract.messages.event import rule_event
from iort_contract.messages.live import LiveSample, encode_live, encode_ping
from iort_contract.messages.requests.ask import Ask, encode_ask
from iort_contract.messages.requests.files import File, FileRequest, encode_file_request
from iort_contract.tables import BATCH, PUT_OFF, RECEIVED_MS, ROBOT_PARAMETER, SERIAL_PARAMETER, TOPIC
from iort_contract.topics import ASK, FILE, LAMBDA, LIVE, PING, RECORD, build_topic

ROBOT = "car"


def events() -> dict[str, dict[str, Any]]:
    """Return the events by the function's name, with the current time: functions ignore late events."""
    now_us = time.time_ns() // 1000
    now_ms = now_us // 1000
    topic = build_topic(RECORD, ROBOT, VESC_STREAM)
    sample = {"speed": 1.5, "voltage_input": 9.5, "fault_code": 5}
    live = LiveSample("aaaaaaaa", 0, now_us, now_us, sample, 0)
    file = File("a.bag", "recording", "application/octet-stream", 1, hashlib.sha256(b"a").hexdigest(), now_us)
    request = FileRequest("0123456789abcdef", file, {1: file.sha256})
    drive = PlannedDrive(DriveKey(ROBOT, now_us - 1_000_000, "aaaaaaaa"), now_us, (VESC_STREAM,), VESC_STREAM)
    ask = Ask("0123456789abcdef", now_us, 5_000, {})
    return {
        "admit": {
            "claimCertificateId": "0" * 64,
            "certificateId": "1" * 64,
            "certificatePem": "",
            "templateArn": "arn:aws:iot:eu-west-1:000000000000:provisioningtemplate/iort",
            "clientId": ROBOT,
            "parameters": {ROBOT_PARAMETER: ROBOT, SERIAL_PARAMETER: "0123456789abcdef"},
        },
        "alert": {TOPIC: build_topic(RECORD, ROBOT, VESC_STREAM), RECEIVED_MS: now_ms, **sample},
        "analyse": {"job": "night", "planned": encode_planned(drive)},
        "answer": rule_event(encode_ask(ask), build_topic(ASK, ROBOT, "calibration"), now_ms),
        "archive": {TASK: DUE},
        "echo": rule_event(encode_ping(1, now_us), build_topic(PING, ROBOT, LAMBDA), now_ms),
        "evaluate": {
            "job": "night",
            "began_us": now_us,
            "robot": ROBOT,
            "others": [],
            "start_us": 0,
            "end_us": 2**53,
            "again": False,
        },
        # A batch that expired while it waited.
        "later": {"Records": [{"messageId": "1", "body": json.dumps({PUT_OFF: [[topic, "1-0-0"]]})}]},
        "live": rule_event(encode_live(live), build_topic(LIVE, ROBOT, VESC_STREAM), now_ms),
        "plan": {"job": "night", "robot": ROBOT, "start_us": now_us - 1_000_000, "end_us": now_us},
        "presence": {
            "clientId": ROBOT,
            "timestamp": now_ms,
            "eventType": "connected",
            "principalIdentifier": "1" * 64,
            "versionNumber": 0,
        },
        "present": {"failed": encode_planned(drive), "error": {"Error": "States.Timeout", "Cause": ""}},
        "quarantine": {"Records": [{"messageId": "1", "body": _rule_error(), "attributes": {}}]},
        "query": {"robot": ROBOT, "stream": VESC_STREAM},
        "summarize": {"Records": [_record(now_us)]},
        "upload": rule_event(encode_file_request(request), build_topic(PING, ROBOT, FILE), now_ms),
    }


def _rule_error() -> str:
    return json.dumps(
        {
            "ruleName": "iort_record",
            "topic": build_topic(RECORD, ROBOT, VESC_STREAM),
            "clientId": ROBOT,
            "base64OriginalPayload": base64.b64encode(b"{}").decode(),
            "failures": [{"failedAction": "DynamoDBv2Action", "errorMessage": "no key"}],
        }
    )


def _record(now_us: int) -> dict[str, Any]:
    """A stored batch of a second, as the telemetry table's stream has it."""
    times = [now_us + i * 20_000 for i in range(50)]
    batch = Batch("aaaaaaaa", 0, times, {"speed": [1.5] * 50, "voltage_input": [9.5] * 50})
    item = {
        **json.loads(encode_batch(batch)),
        TOPIC: build_topic(RECORD, ROBOT, VESC_STREAM),
        RECEIVED_MS: now_us // 1000,
    }
    image = {name: TypeSerializer().serialize(value) for name, value in item.items()}
    return {
        "eventName": "INSERT",
        "eventSource": "aws:dynamodb",
        "dynamodb": {
            "Keys": {name: image[name] for name in (TOPIC, BATCH)},
            "NewImage": image,
            "SequenceNumber": "1".zfill(21),
            "StreamViewType": "NEW_IMAGE",
        },
    }
