"""Copies a stream into another deployment, byte for byte: batches and archived hours; and compares both."""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

from botocore.exceptions import ClientError

from iort_analysis.archive.hours import HourFile, is_expiring, key_of
from iort_analysis.archive.stored import HEADER, ahead
from iort_analysis.samples.batches import Item
from iort_contract import archive
from iort_contract.dynamodb import Keys, starting_between, whole
from iort_contract.tables import BATCH, ENVELOPE, EXPIRES_S
from iort_contract.topics import parse_topic
from iort_station.cloud import Cloud
from iort_station.data.recorded import UNITS_PER_S, Recorded, archive_of, telemetry_table, write
from iort_station.errors import StationError
from iort_station.operations.audit import Audit, audit

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
    """Copy what only the source's archive still has, of hours that `copy_hours` has not copied, into the
    target's table, from where its own archive takes it up; returns the number of batches."""
    ours, theirs = archive_of(source, topic), archive_of(target, topic)
    there = {row.hour: row for row in theirs.rows()}
    table, batches = telemetry_table(target), 0
    for row in ours.rows():
        their = there.get(row.hour)
        if not is_expiring(row) or (their is not None and their.content == row.content):
            continue
        known = set() if their is None else set(theirs.read(their, HourFile.ids))
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


def copy_hours(source: Cloud, target: Cloud, topic: str) -> int:
    """Copy the archived hours that the target lacks, their objects first and the manifest's row last; returns
    how many.

    None of the target's objects and rows is replaced: `merge_hours` copies what the target lacks of an hour
    that both have, and of a day of which the target has another object.
    """
    there, copied = {row.hour for row in archive_of(target, topic).rows()}, 0
    objects: dict[str, bool] = {}
    for row in archive_of(source, topic).rows():
        if row.hour in there:
            continue
        # A day's hours are in one object.
        if row.key and row.key not in objects:
            objects[row.key] = _copy_object(source, target, row.key, row.sha256)
        refused = archive.refused_key(parse_topic(topic), archive.parse_hour(row.hour))
        good = objects.get(row.key, True) and (not row.refused or _copy_object(source, target, refused))
        copied += good and _is_new(
            target.client("dynamodb").put_item,
            TableName=target.output("storage", "ArchiveTable"),
            Item=row.item(),
            ConditionExpression="attribute_not_exists(content)",
        )
    return copied


def _is_new(put: Callable[..., Any], **what: Any) -> bool:
    """Put what must not be there; returns whether it was not."""
    try:
        put(**what)
    except ClientError as error:
        if error.response["Error"]["Code"] not in {"PreconditionFailed", "ConditionalCheckFailedException"}:
            raise
        return False
    return True


def _copy_object(source: Cloud, target: Cloud, key: str, sha256: str | None = None) -> bool:
    """Copy an object as it is, unless an interrupted move has; False if the target has another one."""
    try:
        content = bytes(_object(source, key))
    except ClientError as error:
        raise StationError(f"{key} cannot be read: {error.response['Error']['Code']}") from error
    if sha256 is not None and hashlib.sha256(content).hexdigest() != sha256:
        raise StationError(f"{key} is not the object that was archived: run `iort archive verify`")
    what: Any = {"Bucket": target.output("storage", "FilesBucket"), "Key": key}
    return _is_new(target.client("s3").put_object, **what, Body=content, IfNoneMatch="*") or (
        _object(target, key) == content
    )


def _object(cloud: Cloud, key: str) -> bytes:
    bucket = cloud.output("storage", "FilesBucket")
    return cloud.client("s3").get_object(Bucket=bucket, Key=key)["Body"].read()


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
