"""The archive's objects in S3. An object is written only if nobody has written it since it was looked at."""

from __future__ import annotations

import hashlib
from tempfile import TemporaryFile
from typing import IO, TYPE_CHECKING, Any, NamedTuple

from botocore.exceptions import ClientError

if TYPE_CHECKING:
    from types_boto3_s3 import S3Client

_CHUNK = 1024 * 1024


class Stored(NamedTuple):
    """What an object has."""

    sha256: str
    size: int


class Objects:
    """The objects of a bucket."""

    def __init__(self, client: S3Client, bucket: str) -> None:
        self._client, self._bucket = client, bucket

    def etag(self, key: str) -> str | None:
        """The version that an object has now; None without an object."""
        try:
            return self._client.head_object(Bucket=self._bucket, Key=key)["ETag"]
        except ClientError as error:
            if error.response["Error"]["Code"] in {"404", "NoSuchKey", "NotFound"}:
                return None
            raise

    def read(self, key: str) -> tuple[IO[bytes], str]:
        """An object as a temporary file, and its version."""
        answer = self._client.get_object(Bucket=self._bucket, Key=key)
        file = TemporaryFile()  # noqa: SIM115 - the caller's
        for chunk in answer["Body"].iter_chunks(_CHUNK):
            file.write(chunk)
        file.seek(0)
        return file, answer["ETag"]

    def write(self, key: str, file: IO[bytes], etag: str | None) -> Stored:
        """Write a file's content if the object still has this version; raises `ClientError` if it has not."""
        condition: dict[str, Any] = {"IfNoneMatch": "*"} if etag is None else {"IfMatch": etag}
        digest = hashlib.sha256()
        file.seek(0)
        while chunk := file.read(_CHUNK):
            digest.update(chunk)
        size = file.tell()
        file.seek(0)
        self._client.put_object(
            Bucket=self._bucket, Key=key, Body=file, ChecksumAlgorithm="SHA256", **condition
        )
        return Stored(digest.hexdigest(), size)

    def remove(self, key: str, etag: str) -> None:
        """Remove an object, unless it has been written again."""
        try:
            self._client.delete_object(Bucket=self._bucket, Key=key, IfMatch=etag)
        except ClientError as error:
            if error.response["Error"]["Code"] not in {"PreconditionFailed", "NoSuchKey"}:
                raise
