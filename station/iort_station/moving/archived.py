"""Moves a stream's archived hours: the objects and the manifest's rows."""

from __future__ import annotations

import hashlib
import io
from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

from botocore.exceptions import ClientError

from iort_analysis.archive.reading import ArchiveFile
from iort_analysis.archive.writing import described, write_day
from iort_contract.archive import ArchivedHour, hour_key, parse_hour, refused_key
from iort_contract.topics import parse_topic
from iort_station.cloud import Cloud
from iort_station.data.recorded import archive_of
from iort_station.errors import StationError


class Hours(NamedTuple):
    """The hours that were copied, and those that were ``left`` since the target is about to write them."""

    copied: int
    left: int


def copy(source: Cloud, target: Cloud, topic: str) -> Hours:
    """Copy the hours that the target lacks; the manifest's row comes last.

    An hour that both have stays as it is: `iort_station.moving.recorded.merge` copies what the target lacks.
    """
    there = {row.hour for row in archive_of(target, topic).rows()}
    copied = left = 0
    copies = _Objects(source, target)
    for row in archive_of(source, topic).rows():
        if row.hour in there:
            continue
        new: ArchivedHour | None = row
        if row.key and not copies.copy(row.key, row.sha256):
            # The target has another object of this day, with hours of its own.
            new = copies.copy_hour(row)
        refused = refused_key(parse_topic(topic), parse_hour(row.hour))
        if new and (not row.refused or copies.copy(refused)) and _put_row(target, new):
            copied += 1
        else:
            left += 1
    return Hours(copied, left)


def _put_row(target: Cloud, row: ArchivedHour) -> bool:
    """Write a row; returns False if the target has one of this hour by now."""
    return _is_new(
        target.client("dynamodb").put_item,
        TableName=target.output("storage", "ArchiveTable"),
        Item=row.item(),
        ConditionExpression="attribute_not_exists(content)",
    )


def _is_new(put: Callable[..., Any], **what: Any) -> bool:
    """Put what must not be there; returns whether it was not."""
    try:
        put(**what)
    except ClientError as error:
        if error.response["Error"]["Code"] not in {"PreconditionFailed", "ConditionalCheckFailedException"}:
            raise
        return False
    return True


class _Objects:
    """Copies the archive's objects, each once: a day's hours are in one. None of the target's is replaced."""

    def __init__(self, source: Cloud, target: Cloud) -> None:
        self._from, self._to = source.client("s3"), target.client("s3")
        self._source, self._target = (one.output("storage", "FilesBucket") for one in (source, target))
        self._copied: dict[str, bool] = {}
        self._day: tuple[str, ArchiveFile] | None = None

    def copy(self, key: str, sha256: str | None = None) -> bool:
        """Copy an object as it is; returns False if the target has another one."""
        if key not in self._copied:
            self._copied[key] = self._put(key, self._read(key, sha256))
        return self._copied[key]

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
        if not self._put(key, content):
            return None
        return replace(row, key=key, sha256=hashlib.sha256(content).hexdigest(), size_bytes=len(content))

    def _put(self, key: str, content: bytes) -> bool:
        """Write an object, unless an interrupted move has; returns False if the target has another one."""
        what: Any = {"Bucket": self._target, "Key": key}
        if _is_new(self._to.put_object, **what, Body=content, IfNoneMatch="*"):
            return True
        return bool(self._to.get_object(**what)["Body"].read() == content)

    def _read(self, key: str, sha256: str | None) -> bytes:
        try:
            content = bytes(self._from.get_object(Bucket=self._source, Key=key)["Body"].read())
        except ClientError as error:
            raise StationError(f"{key} cannot be read: {error.response['Error']['Code']}") from error
        if sha256 is not None and hashlib.sha256(content).hexdigest() != sha256:
            raise StationError(f"{key} is not the object that was archived: run `iort archive verify`")
        return content
