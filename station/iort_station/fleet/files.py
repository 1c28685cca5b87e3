"""The files that robots have uploaded: listed, downloaded and deleted."""

from __future__ import annotations

import hashlib
import os
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any

from botocore.exceptions import BotoCoreError, ClientError
from urllib3.exceptions import HTTPError

from iort_contract.limits import ContractError
from iort_contract.messages.files import FILES_PREFIX, parse_file_key
from iort_station.cloud import Cloud
from iort_station.errors import StationError
from iort_station.fleet import registry

if TYPE_CHECKING:
    from types_boto3_s3.type_defs import ObjectIdentifierTypeDef

_CHUNK_BYTES = 1024 * 1024
# What `Ranged` fetches at least.
_BLOCK_BYTES = 64 * 1024
# DeleteObjects takes at most so many keys.
_DELETE_SIZE = 1000

# Receives the number of further bytes downloaded, or of further files deleted.
CountProgress = Callable[[int], None]


@dataclass(frozen=True)
class StoredFile:
    """A file in the bucket. ``second`` is the time of the robot's last write, ``stored_s`` that of its
    arrival; both since the epoch."""

    key: str
    robot: str
    name: str
    size: int
    second: int
    stored_s: float


def listed(
    cloud: Cloud, robot: str | None, *, start_us: int | None = None, end_us: int | None = None
) -> Iterator[StoredFile]:
    """A robot's files that it last wrote in the range, in order of time. The end is exclusive. None gives the
    files of all robots, also of removed ones, and has no range.

    Raises `UsageError` for an invalid name.
    """
    prefix = FILES_PREFIX if robot is None else f"{FILES_PREFIX}{registry.checked(robot)}/"
    # The key begins with the time, so only the range is listed.
    after = prefix if start_us is None else prefix + _day(start_us)
    pages = cloud.client("s3").get_paginator("list_objects_v2")
    for page in pages.paginate(Bucket=_bucket(cloud), Prefix=prefix, StartAfter=after):
        for entry in page.get("Contents", ()):
            try:
                key = parse_file_key(entry["Key"])
            except ContractError:
                continue  # not a file of a robot
            if end_us is not None and key.second * 1_000_000 >= end_us:
                return
            if start_us is None or (key.second + 1) * 1_000_000 > start_us:
                stored_s = entry["LastModified"].timestamp()
                yield StoredFile(entry["Key"], key.robot, key.name, entry["Size"], key.second, stored_s)


def stored(cloud: Cloud, key: str) -> StoredFile | None:
    """The file of a key; None if the bucket does not have it (any more)."""
    client = cloud.client("s3")
    try:
        named = parse_file_key(key)
        head = client.head_object(Bucket=_bucket(cloud), Key=key)
    except ContractError as error:
        raise StationError(str(error)) from error
    except ClientError as error:
        if error.response["Error"]["Code"] in {"404", "NoSuchKey"}:
            return None
        raise
    return StoredFile(
        key, named.robot, named.name, head["ContentLength"], named.second, head["LastModified"].timestamp()
    )


def download(
    cloud: Cloud,
    file: StoredFile,
    out: Path,
    progress: CountProgress = lambda _bytes: None,
    *,
    force: bool = False,
) -> Path:
    """Download a file to ``out/<its name>``, continuing a partial download; returns its path.

    Raises `StationError` for a wrong SHA-256, and if another file has this name, unless ``force``.
    """
    client, bucket = cloud.client("s3"), _bucket(cloud)
    head = client.head_object(Bucket=bucket, Key=file.key)
    expected = head["Metadata"].get("sha256", "")
    path = out / file.name
    if path.exists():
        if _sha256(path).hexdigest() == expected:
            progress(file.size)
            return path
        if not force:
            raise StationError(f"{path} is another file: give another --out, or overwrite it with --force")
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(f"{path.name}.{expected[:12]}.part")
    digest = _sha256(part) if part.exists() else hashlib.sha256()
    there = part.stat().st_size if part.exists() else 0
    progress(there)
    part.touch()  # Of an empty file nothing comes.
    if there < file.size:
        # The object must be the one of the head.
        body = client.get_object(Bucket=bucket, Key=file.key, IfMatch=head["ETag"], Range=f"bytes={there}-")[
            "Body"
        ]
        with part.open("ab") as written:
            for chunk in _chunks(body, file.key):
                digest.update(chunk)
                written.write(chunk)
                progress(len(chunk))
    if digest.hexdigest() != expected:
        part.unlink()
        raise StationError(f"{file.key}: SHA-256 must be {expected}, got {digest.hexdigest()}")
    part.replace(path)
    return path


def damage(cloud: Cloud, file: StoredFile, progress: CountProgress = lambda _bytes: None) -> str:
    """Read a file; returns why it is not the one that the robot sent, empty if it is."""
    digest = hashlib.sha256()
    try:
        answer = cloud.client("s3").get_object(Bucket=_bucket(cloud), Key=file.key)
    except ClientError as error:
        return f"cannot be read: {error.response['Error']['Code']}"
    for chunk in _chunks(answer["Body"], file.key):
        digest.update(chunk)
        progress(len(chunk))
    expected = answer["Metadata"].get("sha256")
    return (
        f"SHA-256 must be {expected}, got {digest.hexdigest()}"
        if expected not in {None, digest.hexdigest()}
        else ""
    )


class Ranged:
    """A stored file that is read in parts, for libraries that seek: only what is read is fetched, in blocks.

    It fetches at most ``most`` bytes, whatever it is asked for; then it raises `ValueError`. Less than a
    block counts as one, so that the requests are bounded, too. Raises `StationError` without a connection.
    """

    def __init__(self, cloud: Cloud, file: StoredFile, most: int) -> None:
        self._client, self._bucket, self._file = cloud.client("s3"), _bucket(cloud), file
        self.most, self._place, self._from, self._block = most, 0, 0, b""

    def seekable(self) -> bool:
        return True

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        begin = {os.SEEK_SET: 0, os.SEEK_CUR: self._place, os.SEEK_END: self._file.size}[whence]
        self._place = max(0, begin + offset)
        return self._place

    def tell(self) -> int:
        return self._place

    def read(self, size: int = -1) -> bytes:
        """The next bytes: fewer at the file's end."""
        left = max(0, self._file.size - self._place)
        size = left if size < 0 else min(size, left)
        if not self._from <= self._place <= self._place + size <= self._from + len(self._block):
            self._fetch(min(left, max(size, _BLOCK_BYTES)))
        begin = self._place - self._from
        self._place += size
        return self._block[begin : begin + size]

    def _fetch(self, size: int) -> None:
        self.most -= max(size, _BLOCK_BYTES)
        if self.most < 0:
            raise ValueError(f"{self._file.key}: there is too much to read")
        if size:
            part = f"bytes={self._place}-{self._place + size - 1}"
            try:
                body = self._client.get_object(Bucket=self._bucket, Key=self._file.key, Range=part)["Body"]
            except BotoCoreError as error:
                # Some of them are an `OSError`, as those of a file that is damaged.
                raise StationError(f"{self._file.key}: {error}") from error
            self._block, self._from = b"".join(_chunks(body, self._file.key)), self._place


def content(cloud: Cloud, key: str) -> bytes | None:
    """A file's content; None if it is not (yet) there."""
    client = cloud.client("s3")
    try:
        return bytes(client.get_object(Bucket=_bucket(cloud), Key=key)["Body"].read())
    except client.exceptions.NoSuchKey:
        return None


def empty(cloud: Cloud, progress: CountProgress = lambda _count: None) -> None:
    """Delete everything in the bucket, including unfinished uploads and earlier versions, before its stack is
    deleted."""
    client, bucket = cloud.client("s3"), _bucket(cloud)
    uploads = client.get_paginator("list_multipart_uploads").paginate(Bucket=bucket)
    for begun in [upload for page in uploads for upload in page.get("Uploads", ())]:
        client.abort_multipart_upload(Bucket=bucket, Key=begun["Key"], UploadId=begun["UploadId"])
        progress(1)
    # An object of a bucket without versions is its version "null": "ListObjectVersions".
    pages = client.get_paginator("list_object_versions").paginate(Bucket=bucket)
    versions: list[ObjectIdentifierTypeDef] = [
        {"Key": entry["Key"], "VersionId": entry["VersionId"]}
        for page in pages
        for entry in (*page.get("Versions", ()), *page.get("DeleteMarkers", ()))
    ]
    every = iter(versions)
    while chunk := list(islice(every, _DELETE_SIZE)):
        answer = client.delete_objects(Bucket=bucket, Delete={"Objects": chunk, "Quiet": True})
        if answer.get("Errors"):
            first = answer["Errors"][0]
            raise StationError(f"{first['Key']} cannot be deleted: {first['Code']} {first['Message']}")
        progress(len(chunk))


def is_empty(cloud: Cloud) -> bool:
    """Whether CloudFormation can delete the bucket: no object, and no earlier version of one."""
    answer = cloud.client("s3").list_object_versions(Bucket=_bucket(cloud), MaxKeys=1)
    return not answer.get("Versions") and not answer.get("DeleteMarkers")


def _bucket(cloud: Cloud) -> str:
    return cloud.output("storage", "FilesBucket")


def _day(t_us: int) -> str:
    return time.strftime("%Y/%m/%d/", time.gmtime(max(0, t_us // 1_000_000)))


def _chunks(body: Any, key: str) -> Iterator[bytes]:
    try:
        yield from body.iter_chunks(_CHUNK_BYTES)
    except (BotoCoreError, ClientError, HTTPError) as error:
        raise StationError(
            f"{key}: the download was interrupted; run it again to continue: {error}"
        ) from error


def _sha256(path: Path) -> Any:
    digest = hashlib.sha256()
    with path.open("rb") as file:
        while chunk := file.read(_CHUNK_BYTES):
            digest.update(chunk)
    return digest
