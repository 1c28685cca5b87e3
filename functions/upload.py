"""Upload: signs upload addresses, requested over MQTT, so that no robot holds AWS keys."""

from __future__ import annotations

import base64
import hashlib
import logging
import time
from collections.abc import Iterator, Mapping
from itertools import groupby
from typing import TYPE_CHECKING, Any, NamedTuple

from botocore.exceptions import ClientError

from functions.shared import clients
from functions.shared.clients import variables
from functions.shared.metrics import emit
from functions.shared.queues import quarantined
from functions.shared.quotas import DAY, Quota
from iort_contract.catalog.environments import UploadEnvironment
from iort_contract.checks import json_object
from iort_contract.limits import ContractError
from iort_contract.messages.envelope import event_message
from iort_contract.messages.files import (
    UPLOAD_URL_S,
    Address,
    File,
    FileAnswer,
    FileRequest,
    decode_file_request,
    encode_file_answer,
    file_key,
    file_request_id,
    part_range,
)
from iort_contract.tables import FILES_BYTES, FILES_DAY, TOPIC
from iort_contract.topics import FILE, PONG, Topic, build_topic, parse_topic

if TYPE_CHECKING:
    from types_boto3_s3 import S3Client


class Part(NamedTuple):
    """A part in S3, which has computed the SHA-256 and compared it with the signed one."""

    etag: str
    sha256: str


class Bucket:
    """The files' bucket. ``signer`` signs robots' addresses, unless ``client`` does."""

    def __init__(self, client: S3Client, name: str, signer: S3Client | None = None) -> None:
        self._client, self._name, self._signer = client, name, signer or client

    def has(self, key: str) -> bool:
        """Whether an object with the key exists."""
        found = self._client.list_objects_v2(Bucket=self._name, Prefix=key, MaxKeys=1)
        # A key sorts before its own extensions.
        return any(one["Key"] == key for one in found.get("Contents", ()))

    def upload_of(self, key: str) -> str | None:
        """The id of an unfinished upload of the key; the oldest if there are several."""
        pages = self._client.get_paginator("list_multipart_uploads")
        uploads = [
            (one["Initiated"], one["UploadId"])
            for page in pages.paginate(Bucket=self._name, Prefix=key)
            for one in page.get("Uploads", ())
            if one["Key"] == key
        ]
        return min(uploads)[1] if uploads else None

    def begin(self, key: str, file: File) -> str:
        """Begin a multipart upload; return its id."""
        begun = self._client.create_multipart_upload(
            Bucket=self._name,
            Key=key,
            ContentType=file.content_type,
            Metadata=metadata(file),
            ChecksumAlgorithm="SHA256",
        )
        return str(begun["UploadId"])

    def parts(self, key: str, upload_id: str) -> dict[int, Part]:
        """The uploaded parts by number."""
        pages = self._client.get_paginator("list_parts")
        return {
            int(one["PartNumber"]): Part(one["ETag"], base64.b64decode(one["ChecksumSHA256"]).hex())
            for page in pages.paginate(Bucket=self._name, Key=key, UploadId=upload_id)
            for one in page.get("Parts", ())
        }

    def address(self, key: str, file: File) -> Address:
        """The address to upload a whole file: fixed content, size and key, usable once."""
        checksum = _base64(file.sha256)
        url = self._sign(
            "put_object",
            Key=key,
            ContentType=file.content_type,
            ContentLength=file.size,
            ChecksumSHA256=checksum,
            IfNoneMatch="*",
            Metadata=metadata(file),
        )
        headers = {
            "content-type": file.content_type,
            "content-length": str(file.size),
            "x-amz-checksum-sha256": checksum,
            "if-none-match": "*",
            **{f"x-amz-meta-{name}": value for name, value in metadata(file).items()},
        }
        return Address(1, url, headers)

    def part_address(self, key: str, file: File, upload_id: str, part: int, sha256: str) -> Address:
        """The address to upload one part: fixed content and size."""
        _, size = part_range(file, part)
        checksum = _base64(sha256)
        url = self._sign(
            "upload_part",
            Key=key,
            UploadId=upload_id,
            PartNumber=part,
            ContentLength=size,
            ChecksumSHA256=checksum,
        )
        return Address(part, url, {"content-length": str(size), "x-amz-checksum-sha256": checksum})

    def complete(self, key: str, upload_id: str, parts: Mapping[int, Part], size: int) -> None:
        """Join the parts to one object. If another call has just done so, this does nothing."""
        named: list[Any] = [
            {"PartNumber": n, "ETag": part.etag, "ChecksumSHA256": _base64(part.sha256)}
            for n, part in sorted(parts.items())
        ]
        try:
            self._client.complete_multipart_upload(
                Bucket=self._name,
                Key=key,
                UploadId=upload_id,
                MultipartUpload={"Parts": named},
                MpuObjectSize=size,
                IfNoneMatch="*",
            )
        except ClientError as error:
            ended = error.response["Error"]["Code"] in {"NoSuchUpload", "PreconditionFailed"}
            if not ended or not self.has(key):
                raise

    def abort(self, key: str, upload_id: str) -> None:
        """Delete the parts of an upload."""
        self._client.abort_multipart_upload(Bucket=self._name, Key=key, UploadId=upload_id)

    def _sign(self, operation: str, **parameters: Any) -> str:
        url: str = self._signer.generate_presigned_url(
            operation, Params={"Bucket": self._name, **parameters}, ExpiresIn=UPLOAD_URL_S
        )
        return url


def metadata(file: File) -> dict[str, str]:
    """An object's metadata; `iort files get` checks the SHA-256 of the whole."""
    return {"sha256": file.sha256, "kind": file.kind, "t": str(file.t_us)}


def parts_sha256(parts: Mapping[int, Part]) -> str:
    """The SHA-256 of the parts' SHA-256, in order."""
    return hashlib.sha256(b"".join(bytes.fromhex(parts[n].sha256) for n in sorted(parts))).hexdigest()


def _base64(sha256: str) -> str:
    return base64.b64encode(bytes.fromhex(sha256)).decode()


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
        return FileAnswer(request.id, key, stored=False, addresses=addresses)
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
    return FileAnswer(request.id, key, stored=False, have=tuple(ranges(there)), addresses=addresses)


def ranges(numbers: Mapping[int, Any]) -> Iterator[tuple[int, int]]:
    """The numbers as ranges, both ends inclusive."""
    for _, several in groupby(enumerate(sorted(numbers)), lambda placed: placed[1] - placed[0]):
        row = [number for _, number in several]
        yield row[0], row[-1]


def _reply(topic: Topic, state: FileAnswer) -> None:
    answers = build_topic(PONG, topic.robot, FILE, topic.namespace)
    clients.iot_data().publish(topic=answers, qos=1, payload=encode_file_answer(state))


@quarantined
def handler(event: Mapping[str, Any]) -> None:
    """Entry point of the upload rule's Lambda action.

    A malformed request is refused; without an id it cannot be answered, and goes to the quarantine.
    """
    environment, topic = variables(UploadEnvironment), parse_topic(event[TOPIC])
    envelope: dict[str, Any] = {}
    try:
        envelope = json_object(event_message(event), "file request")
        request = decode_file_request(envelope)
    except ContractError as error:
        emit("upload", FilesRefused=1)
        request_id = file_request_id(envelope)
        if request_id is None:
            raise
        _log.warning("refused a request of %s: %s", topic.robot, error)
        _reply(topic, FileAnswer(request_id, refused=str(error)))
        return
    bucket = Bucket(clients.s3(), environment.files_bucket, clients.s3_for_robots())
    quota = Quota(
        clients.dynamodb(),
        table=environment.robots_table,
        named=(FILES_DAY, FILES_BYTES),
        period=DAY,
        most=environment.upload_bytes_a_day,
    )
    state = answer(topic.robot, request, bucket, quota, time.time())
    done = bool(state.stored) and request.parts_sha256 is not None
    emit(
        "upload",
        FilesAsked=1,
        FilesRefused=int(state.refused is not None),
        FilesStored=int(done),
        StoredBytes=request.file.size if done else 0,
    )
    _reply(topic, state)
