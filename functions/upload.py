"""Upload: signs upload addresses, requested over MQTT, so that no robot holds AWS keys."""

from __future__ import annotations

import logging
import os
import time
from collections.abc import Iterator, Mapping
from functools import cache
from typing import Any

import boto3
from botocore.config import Config

from functions.shared.bucket import Bucket, parts_sha256
from functions.shared.dead_letter import DeadLetterQueue, refused_event
from functions.shared.metrics import emit
from functions.shared.upload_quota import Allotment
from iort_contract.checks import json_object
from iort_contract.limits import ContractError
from iort_contract.messages.event import event_message
from iort_contract.messages.files import (
    FileAnswer,
    FileRequest,
    decode_file_request,
    encode_file_answer,
    file_key,
    file_request_id,
)
from iort_contract.tables import TOPIC
from iort_contract.topics import FILE, PONG, Topic, build_topic, parse_topic

_log = logging.getLogger(__name__)
_log.setLevel(logging.INFO)

_AGAIN_S = 3600


def answer(
    robot: str, request: FileRequest, bucket: Bucket, allotment: Allotment, now_s: float
) -> FileAnswer:
    """The state of the file in the bucket, and the addresses for the rest. The robot comes from the topic,
    and the key from robot and file, so that no request can reach another file."""
    file, key = request.file, file_key(robot, request.file)
    if bucket.has(key):
        return FileAnswer(request.id, key, stored=True)
    upload_id = bucket.upload_of(key) if file.parts > 1 else None
    # A file in one piece counts for each address, a larger file when its upload begins.
    begins = upload_id is None and (file.parts > 1 or bool(request.parts))
    if begins and not allotment.take(robot, file.size, now_s):
        why = f"no more than {allotment.bytes_a_day} bytes a day, and only of registered robots"
        return FileAnswer(request.id, refused=why, again_s=_AGAIN_S)
    if file.parts == 1:
        addresses = [bucket.address(key, file)] if request.parts else []
        return FileAnswer(request.id, key, addresses=addresses)
    if upload_id is None:
        upload_id = bucket.begin(key, file)
    there = bucket.parts(key, upload_id)
    if request.parts_sha256 is not None and len(there) == file.parts:
        if parts_sha256(there) != request.parts_sha256:
            bucket.abort(key, upload_id)
            return FileAnswer(request.id, refused="the parts stored are not this file's", again_s=0)
        bucket.complete(key, upload_id, there, file.size)
        return FileAnswer(request.id, key, stored=True)
    addresses = [
        bucket.part_address(key, file, upload_id, part, sha256)
        for part, sha256 in sorted(request.parts.items())
        if part not in there or there[part].sha256 != sha256
    ]
    return FileAnswer(request.id, key, have=tuple(ranges(there)), addresses=addresses)


def ranges(numbers: Mapping[int, Any]) -> Iterator[tuple[int, int]]:
    """The numbers as ranges, both ends inclusive."""
    first = last = None
    for number in sorted(numbers):
        if last is not None and number == last + 1:
            last = number
            continue
        if first is not None and last is not None:
            yield first, last
        first = last = number
    if first is not None and last is not None:
        yield first, last


@cache
def _bucket() -> Bucket:
    # Virtual addressing gives the region's own host: the global one redirects, which invalidates a signature.
    config = Config(signature_version="s3v4", s3={"addressing_style": "virtual"})
    return Bucket(boto3.client("s3", config=config), os.environ["FILES_BUCKET"])


@cache
def _allotment() -> Allotment:
    return Allotment(
        boto3.client("dynamodb"),
        table=os.environ["ROBOTS_TABLE"],
        bytes_a_day=int(os.environ["UPLOAD_BYTES_A_DAY"]),
    )


@cache
def _iot_data() -> Any:
    return boto3.client("iot-data")


@cache
def _refusals() -> DeadLetterQueue:
    return DeadLetterQueue.at_once(os.environ["REJECTED_QUEUE"])


def handler(event: dict[str, Any], context: Any) -> None:
    """Entry point of the upload rule's Lambda action."""
    topic = parse_topic(event[TOPIC])
    envelope: dict[str, Any] = {}
    try:
        envelope = json_object(event_message(event), "file request")
        request = decode_file_request(envelope)
    except ContractError as error:
        _refuse(event, envelope, topic, error, context)
        return
    given = answer(topic.robot, request, _bucket(), _allotment(), time.time())
    done = given.stored and request.parts_sha256 is not None
    emit(
        "upload",
        FilesAsked=1,
        FilesRefused=int(given.refused is not None),
        FilesStored=int(done),
        StoredBytes=request.file.size if done else 0,
    )
    _reply(topic.robot, topic.namespace, given)


def _refuse(
    event: Mapping[str, Any], said: Mapping[str, Any], topic: Topic, error: ContractError, context: Any
) -> None:
    """Tell the robot why. A request without an id goes to the quarantine. Raises `error` if the queue does
    not take it, so that Lambda sends it."""
    _log.warning("refused a request of %s: %s", topic.robot, error)
    emit("upload", FilesRefused=1)
    request_id = file_request_id(said)
    if request_id is not None:
        _reply(topic.robot, topic.namespace, FileAnswer(request_id, refused=str(error)))
    elif not _refusals().keep(refused_event(context.invoked_function_arn, event, str(error))):
        raise error


def _reply(robot: str, namespace: str, given: FileAnswer) -> None:
    topic = build_topic(PONG, robot, FILE, namespace)
    _iot_data().publish(topic=topic, qos=1, payload=encode_file_answer(given))
