"""The files that robots have uploaded: what there is, and how it comes here."""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any

from botocore.exceptions import BotoCoreError, ClientError
from urllib3.exceptions import HTTPError

from iort_contract.limits import ContractError
from iort_contract.messages.files import FILES_PREFIX, parse_file_key
from iort_contract.topics import check_robot
from iort_station.cloud import Cloud
from iort_station.errors import StationError

_CHUNK_BYTES = 1024 * 1024
# DeleteObjects takes at most so many keys.
_DELETE_SIZE = 1000

# Hears how many bytes more are here, or how many things more are gone.
Told = Callable[[int], None]


@dataclass(frozen=True)
class StoredFile:
    """A file in the bucket. ``second`` is when the robot last wrote it, ``stored_s`` when it arrived;
    both since the epoch."""

    key: str
    robot: str
    name: str
    size: int
    second: int
    stored_s: float


def listed(
    cloud: Cloud, robot: str, *, start_us: int | None = None, end_us: int | None = None
) -> Iterator[StoredFile]:
    """A robot's files that it last wrote within the range, both ends included, in that order, page by page.

    Raises `StationError` for a name that is not allowed.
    """
    try:
        prefix = f"{FILES_PREFIX}{check_robot(robot)}/"
    except ContractError as error:
        raise StationError(str(error)) from error
    # The time is in the key, so that S3 begins and we end where the range does.
    after = prefix if start_us is None else prefix + _day(start_us)
    pages = cloud.client("s3").get_paginator("list_objects_v2")
    for page in pages.paginate(Bucket=_bucket(cloud), Prefix=prefix, StartAfter=after):
        for one in page.get("Contents", ()):
            try:
                key = parse_file_key(one["Key"])
            except ContractError:
                continue  # somebody else's, put there by hand
            if end_us is not None and key.second * 1_000_000 > end_us:
                return
            if start_us is None or (key.second + 1) * 1_000_000 > start_us:
                stored_s = one["LastModified"].timestamp()
                yield StoredFile(one["Key"], key.robot, key.name, one["Size"], key.second, stored_s)


def download(cloud: Cloud, file: StoredFile, out: Path, told: Told = lambda _bytes: None) -> Path:
    """Bring a file to ``out/<its name>``, going on with a part that is there; its path.

    Raises `StationError` where what arrives does not have the SHA-256 that the robot said, and where
    another file is in the way.
    """
    client, bucket = cloud.client("s3"), _bucket(cloud)
    head = client.head_object(Bucket=bucket, Key=file.key)
    said = head["Metadata"].get("sha256", "")
    path = out / file.name
    if path.exists():
        if _sha256(path).hexdigest() == said:
            told(file.size)
            return path
        raise StationError(f"{path} is there, and is another file: move it away, or give --out")
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(f"{path.name}.{said[:12]}.part")
    digest = _sha256(part) if part.exists() else hashlib.sha256()
    there = part.stat().st_size if part.exists() else 0
    told(there)
    if there < file.size:
        # Of the object that the head is of, and no other.
        wanted = {"Range": f"bytes={there}-"} if there else {}
        body = client.get_object(Bucket=bucket, Key=file.key, IfMatch=head["ETag"], **wanted)["Body"]
        with part.open("ab") as written:
            for chunk in _chunks(body, file.key):
                digest.update(chunk)
                written.write(chunk)
                told(len(chunk))
    if digest.hexdigest() != said:
        part.unlink()
        raise StationError(
            f"{file.key}: what arrived is not what the robot sent: SHA-256 {digest.hexdigest()}"
        )
    part.replace(path)
    return path


def content(cloud: Cloud, key: str) -> bytes | None:
    """What a file holds; None where it is not there, or not yet."""
    client = cloud.client("s3")
    try:
        return bytes(client.get_object(Bucket=_bucket(cloud), Key=key)["Body"].read())
    except client.exceptions.NoSuchKey:
        return None


def empty(cloud: Cloud, told: Told = lambda _count: None) -> None:
    """Delete everything in the bucket, uploads that were begun included: for a stack that is to go."""
    client, bucket = cloud.client("s3"), _bucket(cloud)
    uploads = client.get_paginator("list_multipart_uploads").paginate(Bucket=bucket)
    for begun in [one for page in uploads for one in page.get("Uploads", ())]:
        client.abort_multipart_upload(Bucket=bucket, Key=begun["Key"], UploadId=begun["UploadId"])
        told(1)
    pages = client.get_paginator("list_objects_v2").paginate(Bucket=bucket)
    keys = iter([one["Key"] for page in pages for one in page.get("Contents", ())])
    while chunk := [{"Key": key} for key in islice(keys, _DELETE_SIZE)]:
        answer = client.delete_objects(Bucket=bucket, Delete={"Objects": chunk, "Quiet": True})
        if answer.get("Errors"):
            first = answer["Errors"][0]
            raise StationError(f"{first['Key']} cannot be deleted: {first['Code']} {first['Message']}")
        told(len(chunk))


def _bucket(cloud: Cloud) -> str:
    return cloud.output("storage", "FilesBucket")


def _day(t_us: int) -> str:
    return time.strftime("%Y/%m/%d/", time.gmtime(max(0, t_us // 1_000_000)))


def _chunks(body: Any, key: str) -> Iterator[bytes]:
    try:
        yield from body.iter_chunks(_CHUNK_BYTES)
    except (BotoCoreError, ClientError, HTTPError) as error:
        raise StationError(
            f"{key}: the download broke off, and goes on when started again: {error}"
        ) from error


def _sha256(path: Path) -> Any:
    digest = hashlib.sha256()
    with path.open("rb") as file:
        while chunk := file.read(_CHUNK_BYTES):
            digest.update(chunk)
    return digest
