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


class Version(NamedTuple):
    """A version of an object, and when it was written."""

    etag: str
    written_ms: int


class Read(NamedTuple):
    """An object as a temporary file, its version, and its SHA-256."""

    file: IO[bytes]
    etag: str
    sha256: str


class Objects:
    """The objects of a bucket."""

    def __init__(self, client: S3Client, bucket: str) -> None:
        self._client, self._bucket = client, bucket

    def etag(self, key: str) -> str | None:
        """The version that an object has now; None without an object."""
        version = self.version(key)
        return version.etag if version is not None else None

    def version(self, key: str) -> Version | None:
        """The version that an object has now; None without an object."""
        try:
            head = self._client.head_object(Bucket=self._bucket, Key=key)
            return Version(head["ETag"], round(head["LastModified"].timestamp() * 1000))
        except ClientError as error:
            if error.response["Error"]["Code"] in {"404", "NoSuchKey", "NotFound"}:
                return None
            raise

    def read(self, key: str) -> Read:
        """Read an object."""
        answer = self._client.get_object(Bucket=self._bucket, Key=key)
        file, digest = TemporaryFile(), hashlib.sha256()  # noqa: SIM115 - the caller's
        for chunk in answer["Body"].iter_chunks(_CHUNK):
            file.write(chunk)
            digest.update(chunk)
        file.seek(0)
        return Read(file, answer["ETag"], digest.hexdigest())

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
