"""Copies a stream into another deployment, byte for byte: batches and archived hours; and compares both."""

from __future__ import annotations

import hashlib
import io
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

from botocore.exceptions import ClientError

from iort_analysis.archive.hours import HourFile, is_expiring, key_of
from iort_analysis.archive.reading import ArchiveFile
from iort_analysis.archive.stored import HEADER, ahead
from iort_analysis.archive.writing import described, write_day
from iort_analysis.samples.batches import Item
from iort_contract import archive
from iort_contract.dynamodb import WRITE_ITEMS, Keys, TableError, TelemetryTable, starting_between, whole
from iort_contract.tables import BATCH, ENVELOPE, EXPIRES_S
from iort_contract.topics import parse_topic
from iort_station.cloud import Cloud
from iort_station.data.recorded import Recorded, archive_of, telemetry_table
from iort_station.errors import StationError
from iort_station.operations.audit import Audit, audit

# A write unit writes a kilobyte. AWS accepts 1,000 a second for a partition, which holds a whole topic. Half
# of them are left to the robot.
UNITS_PER_S = 500
_UNIT_BYTES = 1024
# The target's archive finds a batch within a day, by a sweep.
_MERGED_S = 30 * 86_400
# Receives the number of batches read.
BatchProgress = Callable[[int], None]


def copy_batches(
    source: Cloud,
    target: Cloud,
    topic: str,
    *,
    units_per_s: int = UNITS_PER_S,
    progress: BatchProgress = lambda _batches: None,
) -> int:
    """Copy what the target's table lacks, at so many write units a second; returns the number of batches.

    Raises `StationError` if DynamoDB rejects a write. What was copied until then is good.
    """
    table, batches = telemetry_table(target), 0
    for items in ahead(page.items for page in telemetry_table(source).pages(topic)):
        new = list(_lacking(target, topic, items))
        write(table, new, units_per_s)
        batches += len(new)
        progress(len(items))
    return batches


def merge_hours(
    source: Cloud,
    target: Cloud,
    topic: str,
    *,
    units_per_s: int = UNITS_PER_S,
    progress: BatchProgress = lambda _batches: None,
) -> int:
    """Copy what only the source's archive still has of hours that both have archived, into the target's
    table, from where its own archive takes it up; returns the number of batches."""
    ours, theirs = archive_of(source, topic), archive_of(target, topic)
    there = {row.hour: row for row in theirs.rows()}
    table, batches = telemetry_table(target), 0
    for row in ours.rows():
        their = there.get(row.hour)
        if their is None or their.content == row.content or not is_expiring(row):
            continue
        known = set(theirs.read(their, HourFile.ids))
        old = [item for item in ours.read(row, HourFile.items) if key_of(item) not in known]
        expires = {EXPIRES_S: {"N": str(int(time.time()) + _MERGED_S)}}
        new = [{**item, **expires} for item in _lacking(target, topic, old)]
        write(table, new, units_per_s)
        batches += len(new)
        progress(row.batches)
    return batches


def _lacking(target: Cloud, topic: str, items: Sequence[Item]) -> Iterator[Item]:
    """The items that the target does not have, and that DynamoDB is not about to delete."""
    if not items:
        return
    keys = Keys(items[0][BATCH], items[-1][BATCH], empty=False)
    pages = telemetry_table(target).pages(topic, keys, attributes=(BATCH,))
    there = {key_of(item) for page in pages for item in page.items}
    now_s = time.time()
    for item in items:
        expires_s = whole(item, EXPIRES_S)
        if key_of(item) not in there and (expires_s is None or expires_s > now_s):
            yield item


def write(table: TelemetryTable, items: Sequence[Mapping[str, Any]], units_per_s: int) -> None:
    """Write items at so many write units a second; raises `StationError` if DynamoDB rejects them."""
    for start in range(0, len(items), WRITE_ITEMS):
        part, began = items[start : start + WRITE_ITEMS], time.monotonic()
        try:
            table.put(part)
        except TableError as error:
            raise StationError(f"{error}; do it again, or with fewer --units") from error
        # About the units of an item, which is nearly all samples.
        units = sum(-(-len(str(item)) // _UNIT_BYTES) for item in part)
        time.sleep(max(0.0, began + units / units_per_s - time.monotonic()))


# Moves a stream's archived hours: the objects and the manifest's rows.


class Hours(NamedTuple):
    """The hours that were copied, and those that were ``left`` since the target is about to write them."""

    copied: int
    left: int


def copy_hours(source: Cloud, target: Cloud, topic: str) -> Hours:
    """Copy the hours that the target lacks; the manifest's row comes last.

    An hour that both have stays as it is: `merge_hours` copies what the target lacks.
    """
    there = {row.hour for row in archive_of(target, topic).rows()}
    copied = left = 0
    copies = _Objects(source, target)
    for row in archive_of(source, topic).rows():
        if row.hour in there:
            continue
        new: archive.ArchivedHour | None = row
        if row.key and not copies.copy(row.key, row.sha256):
            # The target has another object of this day, with hours of its own.
            new = copies.copy_hour(row)
        refused = archive.refused_key(parse_topic(topic), archive.parse_hour(row.hour))
        if new and (not row.refused or copies.copy(refused)) and _put_row(target, new):
            copied += 1
        else:
            left += 1
    return Hours(copied, left)


def _put_row(target: Cloud, row: archive.ArchivedHour) -> bool:
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

    def copy_hour(self, row: archive.ArchivedHour) -> archive.ArchivedHour | None:
        """Copy an hour of a day's object into an object of its own, as before the day was joined.

        Returns its row; None if the target has such an object already, and is about to point to it.
        """
        topic, hour = parse_topic(row.topic), archive.parse_hour(row.hour)
        if self._day is None or self._day[0] != row.key:
            self._day = row.key, ArchiveFile(self._read(row.key, row.sha256))
        into = io.BytesIO()
        write_day({hour: self._day[1]}, into, describe=described(topic.name))
        content, key = into.getvalue(), archive.hour_key(topic, hour)
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


@dataclass(frozen=True)
class Compared:
    """The source's batches, the hash over their contents, and their audit; how many of them are ``lacking``
    or ``different`` in the target, and how many ``more`` it has.

    An audit follows from what the hash covers, so the target's audit of the same batches is the same.
    """

    batches: int
    content: str
    audit: Audit
    lacking: int
    different: int
    more: int

    @property
    def problem(self) -> str:
        """What is wrong in the target; empty if nothing is."""
        if self.lacking:
            return f"the target lacks {self.lacking:,} of {self.batches:,} batches: move again"
        return f"{self.different:,} batches have another content in the target" if self.different else ""


class _Batch(NamedTuple):
    key: str
    hash: str
    header: dict[str, Any]


def compare(
    source: Cloud, target: Cloud, robot: str, stream: str, progress: BatchProgress = lambda _batches: None
) -> Compared:
    """Read a stream on both sides, as `iort audit` does: each batch of the source must be in the target, with
    the same content. The target may have more, of a robot that records into it already."""
    theirs = _batches(target, robot, stream, progress)
    hashes: list[tuple[str, str]] = []
    lacking = different = more = 0

    def matched() -> Iterator[dict[str, Any]]:
        nonlocal lacking, different, more
        their = next(theirs, None)
        for one in _batches(source, robot, stream, progress):
            while their is not None and their.key < one.key:
                their, more = next(theirs, None), more + 1
            if their is None or their.key > one.key:
                lacking += 1
            else:
                different += their.hash != one.hash
                their = next(theirs, None)
            hashes.append((one.key, one.hash))
            yield one.header
        more += (their is not None) + sum(1 for _ in theirs)

    audited = audit(stream, matched())
    return Compared(len(hashes), archive.content_hash(hashes), audited, lacking, different, more)


def _batches(cloud: Cloud, robot: str, stream: str, progress: BatchProgress) -> Iterator[_Batch]:
    attributes = tuple({*ENVELOPE, *HEADER, archive.HASH})
    recorded = Recorded(cloud, robot, stream)
    for items in recorded.items(starting_between(None, None), attributes):
        progress(len(items))
        for item in items:
            header = {name: next(iter(item[name].values())) for name in HEADER if name in item}
            yield _Batch(key_of(item), archive.item_hash(dict(item)), header)
    if recorded.refused.count:
        raise StationError(f"{stream} cannot be compared: {recorded.refused.reason}")
