"""Moves a stream's archived hours: the objects and the manifest's rows."""

from __future__ import annotations

import hashlib
import io
from dataclasses import replace
from typing import NamedTuple

from botocore.exceptions import ClientError

from iort_analysis.archive.reading import ArchiveFile
from iort_analysis.archive.writing import described, write_day
from iort_contract.archive import ArchivedHour, hour_key, parse_hour, refused_key
from iort_contract.topics import parse_topic
from iort_station.cloud import Cloud
from iort_station.data.stored.archive import Archive
from iort_station.errors import StationError


class Hours(NamedTuple):
    """The hours that were copied, and those that were ``left`` since the target is about to write them."""

    copied: int
    left: int


def copy(source: Cloud, target: Cloud, topic: str) -> Hours:
    """Copy the hours that the target lacks; the manifest's row comes last.

    An hour that both have is made by each from its own table; `compare` tells if one lacks something.
    """
    rows = list(Archive(target, topic).rows())
    there, objects = {row.hour for row in rows}, {row.key: row.sha256 for row in rows}
    copied = left = 0
    copies = _Objects(source, target)
    for row in Archive(source, topic).rows():
        if row.hour in there:
            continue
        new: ArchivedHour | None = row
        if row.key and objects.get(row.key, row.sha256) != row.sha256:
            # The target has another object of this day, with hours of its own.
            new = copies.copy_hour(row)
        elif row.key:
            copies.copy(row.key, row.sha256)
        if new is None:
            left += 1
            continue
        if row.refused:
            copies.copy(refused_key(parse_topic(topic), parse_hour(row.hour)))
        target.client("dynamodb").put_item(
            TableName=target.output("storage", "ArchiveTable"), Item=new.item()
        )
        copied += 1
    return Hours(copied, left)


class _Objects:
    """Copies the archive's objects, each once: a day's hours are in one."""

    def __init__(self, source: Cloud, target: Cloud) -> None:
        self._from, self._to = source.client("s3"), target.client("s3")
        self._source, self._target = (one.output("storage", "FilesBucket") for one in (source, target))
        self._copied: set[str] = set()
        self._day: tuple[str, ArchiveFile] | None = None

    def copy(self, key: str, sha256: str | None = None) -> None:
        """Copy an object as it is."""
        if key not in self._copied:
            self._to.put_object(Bucket=self._target, Key=key, Body=self._read(key, sha256))
            self._copied.add(key)

    def copy_hour(self, row: ArchivedHour) -> ArchivedHour | None:
        """Copy an hour of a day's object into an object of its own, as before the day was joined.

        Returns its row; None if the target has such an object already, and is about to point to it.
        """
        topic, hour = parse_topic(row.topic), parse_hour(row.hour)
        if self._day is None or self._day[0] != row.key:
            self._day = row.key, ArchiveFile(self._read(row.key, row.sha256))
        into = io.BytesIO()
        write_day({hour: self._day[1]}, into, describe=described(topic.name))
        content, key = into.getvalue(), hour_key(topic, hour)
        try:
            self._to.put_object(Bucket=self._target, Key=key, Body=content, IfNoneMatch="*")
        except ClientError as error:
            if error.response["Error"]["Code"] != "PreconditionFailed":
                raise
            if not self._is(key, content):
                return None
        return replace(row, key=key, sha256=hashlib.sha256(content).hexdigest(), size_bytes=len(content))

    def _is(self, key: str, content: bytes) -> bool:
        """Whether an interrupted move has written the object."""
        return bool(self._to.get_object(Bucket=self._target, Key=key)["Body"].read() == content)

    def _read(self, key: str, sha256: str | None) -> bytes:
        try:
            content = bytes(self._from.get_object(Bucket=self._source, Key=key)["Body"].read())
        except ClientError as error:
            raise StationError(f"{key} cannot be read: {error.response['Error']['Code']}") from error
        if sha256 is not None and hashlib.sha256(content).hexdigest() != sha256:
            raise StationError(f"{key} is not the object that was archived: run `iort archive verify`")
        return content
