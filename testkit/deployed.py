"""The functions as deployed: configuration from the templates, code and layer from the assets."""

from __future__ import annotations

import base64
import hashlib
import json
import time
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from boto3.dynamodb.types import TypeSerializer

from iort_contract.archive import DUE, TASK
from iort_contract.catalog.streams import INCIDENT_STREAM
from iort_contract.catalog.vesc import VESC_STREAM
from iort_contract.messages.analysis import DriveKey, PlannedDrive, encode_planned
from iort_contract.messages.batch import Batch, encode_batch
from iort_contract.messages.envelope import rule_event
from iort_contract.messages.files import File, FileRequest, encode_file_request
from iort_contract.messages.live import LiveSample, encode_live, encode_ping
from iort_contract.messages.questions import Ask, encode_ask
from iort_contract.messages.recorder import KEPT, Incident
from iort_contract.tables import (
    BATCH,
    INCIDENT,
    PUT_OFF,
    RECEIVED_MS,
    ROBOT_PARAMETER,
    SERIAL_PARAMETER,
    T_US,
    TOPIC,
)
from iort_contract.topics import ASK, FILE, LAMBDA, LIVE, PING, RECORD, build_topic
from testkit.runtime import Function


def functions(folder: Path, layer: Path) -> dict[str, Function]:
    """Return every function by its module's name, synthesized into ``folder`` with Lambda 1's ``layer``.

    The analysis has this machine's numpy and pyarrow in place of its layer for AWS' processors.
    """
    # Imported here, because the CDK takes seconds to load.
    from aws_cdk import App  # noqa: PLC0415 - as above

    from app import build  # noqa: PLC0415 - as above
    from stacks.settings import Settings  # noqa: PLC0415 - as above

    arrays, empty = folder / "arrays", folder / "empty"
    (arrays / "python").mkdir(parents=True)
    for name in ("numpy", "numpy.libs", "pyarrow"):
        (arrays / "python" / name).symlink_to(Path(np.__file__).parents[1] / name)
    empty.mkdir()
    folder /= "app"
    app = App(outdir=str(folder))
    build(app, Settings(layer=layer, analysis_layer=empty))
    found = {}
    for stack in app.synth().stacks:
        resources: dict[str, Any] = stack.template["Resources"]
        layers = {
            logical: _asset(folder, one["Properties"]["Content"])
            for logical, one in resources.items()
            if one["Type"] == "AWS::Lambda::LayerVersion"
        }
        for one in resources.values():
            # The CDK has functions of its own, in JavaScript.
            if one["Type"] == "AWS::Lambda::Function" and one["Properties"]["Handler"].startswith(
                "functions."
            ):
                made = _function(folder, one["Properties"], layers)
                of_analysis = made.layer is not None and not any(made.layer.iterdir())
                found[made.name] = replace(made, layer=arrays) if of_analysis else made
    return dict(sorted(found.items()))


def _function(folder: Path, properties: Mapping[str, Any], layers: Mapping[str, Path]) -> Function:
    logging = properties.get("LoggingConfig", {})
    named = [layers[layer["Ref"]] for layer in properties.get("Layers", [])]
    variables = properties.get("Environment", {}).get("Variables", {})
    return Function(
        name=properties["Handler"].split(".")[1],
        handler=properties["Handler"],
        code=_asset(folder, properties["Code"]),
        layer=named[0] if named else None,
        memory_mb=properties["MemorySize"],
        timeout_s=properties["Timeout"],
        environment={name: _text(name, value) for name, value in variables.items()},
        log_format=logging.get("LogFormat", "Text"),
        log_level=logging.get("ApplicationLogLevel", ""),
    )


def _text(name: str, value: Any) -> str:
    """Return a variable's value, or a placeholder for a value that only the deployment knows."""
    if isinstance(value, str):
        return value
    if name.endswith("_QUEUE"):
        return "https://sqs.eu-west-1.amazonaws.com/000000000000/queue"
    return name.lower().replace("_", "-")


def _asset(folder: Path, key: Mapping[str, Any]) -> Path:
    return folder / f"asset.{key['S3Key'].removesuffix('.zip')}"


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
        "incident": {
            TOPIC: build_topic(RECORD, ROBOT, INCIDENT_STREAM),
            T_US: now_us,
            INCIDENT: Incident("0123456789abcdef", "hardbrake", now_us - 1, now_us, KEPT).sample(),
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
