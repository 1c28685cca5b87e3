"""The objects of the archive in its bucket, read and written so that two writers harm nothing."""

from __future__ import annotations

import hashlib
from tempfile import TemporaryFile
from typing import IO, Any, NamedTuple

_CHUNK = 1024 * 1024
_MISSING = frozenset({"404", "NoSuchKey", "NotFound"})
# Another version is there.
CHANGED = frozenset({"PreconditionFailed", "ConditionalRequestConflict", "412", "409"})


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
    """The objects of a bucket; ``client`` is boto3's of S3."""

    def __init__(self, client: Any, bucket: str) -> None:
        self._client, self._bucket = client, bucket

    def version(self, key: str) -> Version | None:
        """The version that an object has now; None without an object."""
        try:
            head = self._client.head_object(Bucket=self._bucket, Key=key)
        except Exception as error:
            if code_of(error) in _MISSING:
                return None
            raise
        return Version(head["ETag"], round(head["LastModified"].timestamp() * 1000))

    def read(self, key: str) -> Read:
        """Read an object."""
        answer = self._client.get_object(Bucket=self._bucket, Key=key)
        file, digest = TemporaryFile(), hashlib.sha256()  # noqa: SIM115 - the caller's
        for chunk in answer["Body"].iter_chunks(_CHUNK):
            file.write(chunk)
            digest.update(chunk)
        file.seek(0)
        return Read(file, answer["ETag"], digest.hexdigest())

    def write(self, key: str, file: IO[bytes], version: Version | None) -> tuple[str, int]:
        """Write a file's content if the object still has this version; returns its SHA-256 and its size.

        Raises the client's error if another version is there: `CHANGED`.
        """
        condition: dict[str, Any] = {"IfNoneMatch": "*"} if version is None else {"IfMatch": version.etag}
        digest = hashlib.sha256()
        file.seek(0)
        while chunk := file.read(_CHUNK):
            digest.update(chunk)
        size = file.tell()
        file.seek(0)
        self._client.put_object(
            Bucket=self._bucket, Key=key, Body=file, ChecksumAlgorithm="SHA256", **condition
        )
        return digest.hexdigest(), size

    def remove(self, key: str, etag: str) -> None:
        """Remove an object, unless it has been written again."""
        try:
            self._client.delete_object(Bucket=self._bucket, Key=key, IfMatch=etag)
        except Exception as error:
            if code_of(error) not in {"PreconditionFailed", "NoSuchKey"}:
                raise


def code_of(error: Exception) -> str:
    """The code of an error of boto3's; "" for any other."""
    answer = getattr(error, "response", None)
    return str(answer.get("Error", {}).get("Code", "")) if isinstance(answer, dict) else ""
