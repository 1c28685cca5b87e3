"""Upload: signs upload addresses, requested over MQTT, so that no robot holds AWS keys."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterator, Mapping
from typing import Any

from functions.shared import clients
from functions.shared.bucket import Bucket, parts_sha256
from functions.shared.dead_letter import DeadLetterQueue, refused_event
from functions.shared.environment import variables
from functions.shared.metrics import emit
from functions.shared.quota import DAY, Quota
from iort_contract.catalog.environments import UploadEnvironment
from iort_contract.checks import json_object
from iort_contract.limits import ContractError
from iort_contract.messages.event import event_message
from iort_contract.messages.requests.files import (
    FileAnswer,
    FileRequest,
    decode_file_request,
    encode_file_answer,
    file_key,
    file_request_id,
)
from iort_contract.tables import FILES_BYTES, FILES_DAY, TOPIC
from iort_contract.topics import FILE, PONG, Topic, build_topic, parse_topic

_log = logging.getLogger(__name__)
_log.setLevel(logging.INFO)

_AGAIN_S = 3600


def answer(robot: str, request: FileRequest, bucket: Bucket, quota: Quota, now_s: float) -> FileAnswer:
    """The state of the file in the bucket, and the addresses for the rest. The robot comes from the topic,
    and the key from robot and file, so that no request can reach another file."""
    file, key = request.file, file_key(robot, request.file)
    if bucket.has(key):
        return FileAnswer(request.id, key, stored=True)
    upload_id = bucket.upload_of(key) if file.parts > 1 else None
    # A file in one piece counts for each address, a larger file when its upload begins.
    begins = upload_id is None and (file.parts > 1 or bool(request.parts))
    if begins and not quota.take(robot, file.size, now_s):
        why = f"no more than {quota.most} bytes a day, and only of registered robots"
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


def serve(
    event: Mapping[str, Any],
    function_arn: str,
    *,
    bucket: Bucket,
    quota: Quota,
    reply: Callable[[Topic, FileAnswer], None],
    keep: Callable[[str], bool],
) -> None:
    """Answer a request by ``reply``. A malformed one is refused; without an id it cannot be answered, and
    goes to the quarantine's queue by ``keep``. Raises `ContractError` if the queue does not take it, so that
    Lambda sends it there."""
    topic = parse_topic(event[TOPIC])
    envelope: dict[str, Any] = {}
    try:
        envelope = json_object(event_message(event), "file request")
        request = decode_file_request(envelope)
    except ContractError as error:
        _log.warning("refused a request of %s: %s", topic.robot, error)
        emit("upload", FilesRefused=1)
        request_id = file_request_id(envelope)
        if request_id is not None:
            reply(topic, FileAnswer(request_id, refused=str(error)))
        elif not keep(refused_event(function_arn, event, str(error))):
            raise
        return
    found = answer(topic.robot, request, bucket, quota, time.time())
    done = found.stored and request.parts_sha256 is not None
    emit(
        "upload",
        FilesAsked=1,
        FilesRefused=int(found.refused is not None),
        FilesStored=int(done),
        StoredBytes=request.file.size if done else 0,
    )
    reply(topic, found)


def _reply(topic: Topic, found: FileAnswer) -> None:
    answers = build_topic(PONG, topic.robot, FILE, topic.namespace)
    clients.iot_data().publish(topic=answers, qos=1, payload=encode_file_answer(found))


def handler(event: dict[str, Any], context: Any) -> None:
    """Entry point of the upload rule's Lambda action."""
    given = variables(UploadEnvironment)
    serve(
        event,
        context.invoked_function_arn,
        bucket=Bucket(clients.s3(), given.files_bucket, clients.s3_for_robots()),
        quota=Quota(
            clients.dynamodb(),
            table=given.robots_table,
            named=(FILES_DAY, FILES_BYTES),
            period=DAY,
            most=given.upload_bytes_a_day,
        ),
        reply=_reply,
        keep=lambda body: DeadLetterQueue(clients.sqs(at_once=True), given.rejected_queue).keep(body),
    )
