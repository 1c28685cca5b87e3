"""Archives what a table in memory holds, as the archive's function does, and lets items expire."""

from __future__ import annotations

import hashlib
import io
from collections.abc import Callable
from dataclasses import replace
from itertools import groupby
from typing import Any

from botocore.exceptions import ClientError

from iort_analysis.archive.reading import ArchiveFile
from iort_analysis.archive.writing import write_day, write_hour
from iort_contract.archive import ArchivedHour, Hour, archived_hour, day_key, hour_key, hour_of, refused_key
from iort_contract.tables import BATCH, TOPIC
from iort_contract.topics import parse_topic
from testkit.dynamodb import ARCHIVE, SUMMARY, TELEMETRY, FakeDynamoDB

Item = dict[str, Any]
NEVER_S, PAST_S = 2**40, 1


class FakeS3:
    """A bucket in memory."""

    def __init__(self) -> None:
        self.objects: dict[str, bytes] = {}
        self.reads: list[tuple[int, int]] = []

    def get_object(
        self, *, Bucket: str, Key: str, Range: str = "bytes=0-", IfMatch: str | None = None
    ) -> dict[str, Any]:
        assert Bucket
        body = self._body(Key)
        if IfMatch not in {None, str(hash(body))}:
            raise ClientError({"Error": {"Code": "PreconditionFailed"}}, "GetObject")
        first, _, last = Range.removeprefix("bytes=").partition("-")
        start = int(first) if first else max(0, len(body) - int(last))
        end = int(last) + 1 if first and last else len(body)
        self.reads.append((start, end))
        content_range = f"bytes {start}-{end - 1}/{len(body)}"
        return {"Body": io.BytesIO(body[start:end]), "ETag": str(hash(body)), "ContentRange": content_range}

    def _body(self, key: str) -> bytes:
        if key not in self.objects:
            raise ClientError({"Error": {"Code": "NoSuchKey"}}, "GetObject")
        return self.objects[key]


def archive(table: FakeDynamoDB, bucket: FakeS3, *, expires_s: int = PAST_S) -> None:
    """Archive every hour of every topic in the table."""
    stored = [table.items[TELEMETRY][key] for key in sorted(table.items[TELEMETRY])]
    for (name, hour), items in groupby(stored, key=lambda item: (item[TOPIC]["S"], _hour(item))):
        into, refused, topic = io.BytesIO(), io.BytesIO(), parse_topic(name)
        done = write_hour(items, into, hour=hour, refused=refused, scratch=io.BytesIO())
        row = ArchivedHour(
            topic=name,
            hour=str(hour),
            key=hour_key(topic, hour) if done.batches else "",
            batches=done.batches,
            samples=done.samples,
            refused=sum(done.refused.values()),
            content=done.content,
            sha256=hashlib.sha256(into.getvalue()).hexdigest(),
            size_bytes=len(into.getvalue()),
            archived_ms=1,
            first_expires_s=expires_s,
        )
        table.put(ARCHIVE, row.item())
        if done.batches:
            bucket.objects[row.key] = into.getvalue()
        if row.refused:
            bucket.objects[refused_key(topic, hour)] = refused.getvalue()


def compact(table: FakeDynamoDB, bucket: FakeS3) -> None:
    """Join the hours of each day to one object, and delete theirs."""
    rows = [item for key, item in sorted(table.items[ARCHIVE].items()) if item["key"]["S"]]
    for (name, _), same in groupby(rows, key=lambda item: (item[TOPIC]["S"], item["hour"]["S"][:10])):
        day, into, topic = list(same), io.BytesIO(), parse_topic(name)
        hours = {_of(item): ArchiveFile(bucket.objects.pop(item["key"]["S"])) for item in day}
        write_day(hours, into, describe=lambda _field: ("", ""))
        key = day_key(topic, min(hours))
        bucket.objects[key] = into.getvalue()
        for item in day:
            row = archived_hour(item)
            sha256, size = hashlib.sha256(into.getvalue()).hexdigest(), len(into.getvalue())
            table.put(ARCHIVE, replace(row, key=key, sha256=sha256, size_bytes=size).item())


def expire(table: FakeDynamoDB, *, every: Callable[[int], bool] = lambda _number: True) -> None:
    """Delete the batches and seconds of the table whose number meets ``every``."""
    for name in (TELEMETRY, SUMMARY):
        for number, key in enumerate(sorted(table.items[name])):
            if every(number):
                del table.items[name][key]


def _hour(item: Item) -> Hour:
    return hour_of(int(item[BATCH]["S"][:16]))


def _of(item: Item) -> Hour:
    from iort_contract.archive import parse_hour

    return parse_hour(item["hour"]["S"])
