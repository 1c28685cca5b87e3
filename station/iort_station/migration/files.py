"""Moves robots' files, such as recordings and images, from bucket to bucket.

A file goes in the parts in which robots upload it. S3 compares each with its SHA-256, and keeps the parts of
an interrupted upload, which the next run continues. A key is of one content, so a file that is there is done.
"""

from __future__ import annotations

import base64
import hashlib
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import Any

from botocore.exceptions import BotoCoreError, ClientError
from urllib3.exceptions import HTTPError

from iort_contract.messages.files import PART_BYTES
from iort_station.cloud import Cloud
from iort_station.errors import StationError
from iort_station.fleet.files import StoredFile

# Receives the number of further bytes that the target has.
BytesProgress = Callable[[int], None]
_AT_ONCE = 8


class Files:
    """The files' buckets of both sides."""

    def __init__(self, source: Cloud, target: Cloud) -> None:
        self._from, self._to = source.client("s3"), target.client("s3")
        self._source, self._target = (one.output("storage", "FilesBucket") for one in (source, target))

    def copy(self, file: StoredFile, progress: BytesProgress) -> str:
        """Copy a file that the target lacks; returns why it is not copied, empty if it is.

        Raises `StationError` if the network fails. The next call continues.
        """
        with _interrupted(file):
            answer: Any = self._from.get_object(Bucket=self._source, Key=file.key)
            given = {"ContentType": answer["ContentType"], "Metadata": answer["Metadata"]}
            said, body = answer["Metadata"].get("sha256"), answer["Body"]
            to: Any = {"Bucket": self._target, "Key": file.key}
            if file.size > PART_BYTES:
                return self._copy_parts(to, given, said, body, progress)
            content = body.read()
            if problem := _problem(hashlib.sha256(content), said):
                return problem
            self._to.put_object(**to, **given, Body=content, ChecksumSHA256=base64_sha256(content))
        progress(file.size)
        return ""

    def _copy_parts(self, to: Any, given: Any, said: str | None, body: Any, progress: BytesProgress) -> str:
        to = {**to, "UploadId": self._upload_of(to) or self._begin(to, given)}
        pages = self._to.get_paginator("list_parts").paginate(**to)
        there = {
            (one["PartNumber"], one["ChecksumSHA256"]): one["ETag"]
            for page in pages
            for one in page.get("Parts", ())
        }
        parts: list[Any] = []
        whole = hashlib.sha256()
        while content := body.read(PART_BYTES):
            whole.update(content)
            part: Any = {"PartNumber": len(parts) + 1, "ChecksumSHA256": base64_sha256(content)}
            etag = there.get((part["PartNumber"], part["ChecksumSHA256"]))
            if etag is None:
                etag = self._to.upload_part(**to, **part, Body=content)["ETag"]
            parts.append({**part, "ETag": etag})
            progress(len(content))
        if problem := _problem(whole, said):
            self._to.abort_multipart_upload(**to)
            return problem
        self._to.complete_multipart_upload(**to, MultipartUpload={"Parts": parts})
        return ""

    def _upload_of(self, to: Any) -> str | None:
        """An unfinished upload of the same file: of an interrupted move, or of the robot."""
        pages = self._to.get_paginator("list_multipart_uploads")
        for page in pages.paginate(Bucket=to["Bucket"], Prefix=to["Key"]):
            for one in page.get("Uploads", ()):
                if one["Key"] == to["Key"]:
                    return str(one["UploadId"])
        return None

    def _begin(self, to: Any, given: Any) -> str:
        return str(self._to.create_multipart_upload(**to, **given, ChecksumAlgorithm="SHA256")["UploadId"])

    def different(self, files: Sequence[StoredFile]) -> list[str]:
        """The keys whose size or SHA-256, as S3 has computed it, are others in the target."""
        with ThreadPoolExecutor(_AT_ONCE) as pool:
            same = pool.map(self._is_same, files)
            return [file.key for file, good in zip(files, same, strict=True) if not good]

    def _is_same(self, file: StoredFile) -> bool:
        here, there = (
            client.head_object(Bucket=bucket, Key=file.key, ChecksumMode="ENABLED")
            for client, bucket in ((self._from, self._source), (self._to, self._target))
        )
        return all(here.get(one) == there.get(one) for one in ("ContentLength", "ChecksumSHA256", "Metadata"))


@contextmanager
def _interrupted(file: StoredFile) -> Iterator[None]:
    try:
        yield
    except (BotoCoreError, HTTPError) as error:
        raise StationError(f"{file.key}: {error}; move again to continue") from error
    except ClientError as error:
        raise StationError(f"{file.key} is not copied: {error}") from error


def _problem(digest: Any, said: str | None) -> str:
    found = digest.hexdigest()
    return f"SHA-256 must be {said}, got {found}" if said not in {None, found} else ""


def base64_sha256(content: bytes) -> str:
    """The SHA-256 as S3 writes it."""
    return base64.b64encode(hashlib.sha256(content).digest()).decode()
