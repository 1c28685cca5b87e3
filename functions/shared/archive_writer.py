"""Archives an hour of a stream: its items from the telemetry table into one object of the bucket.

Exactly once: a run writes the object only over the version that it has seen, and the manifest's row only over
the content that it has seen. A run that is killed leaves the row as it was; the next one writes the object
again. An object that no row names yet, of an import that writes at the same time, goes into what is written.
"""

from __future__ import annotations

import json
import logging
from collections.abc import Iterator, Mapping
from contextlib import ExitStack
from dataclasses import replace
from tempfile import TemporaryFile
from typing import IO, Any

from functions.shared.archive import Archive
from functions.shared.metrics import emit
from iort_analysis.archive.hours import key_of, merged
from iort_analysis.archive.reading import ArchiveFile
from iort_analysis.archive.reading import items as archived_items
from iort_analysis.archive.writing import Written, described, write_day, write_hour
from iort_contract.archive import (
    ArchivedHour,
    Hour,
    Pending,
    archived_hour,
    day_key,
    hour_key,
    hours_between,
    parse_hour,
    refused_key,
)
from iort_contract.dynamodb import Item, starting_between
from iort_contract.topics import parse_topic

_log = logging.getLogger(__name__)
# An item may go a little before its time, by another clock.
_MARGIN_S = 3600


def archive_hour(archive: Archive, pending: Pending, now_ms: int) -> ArchivedHour | None:
    """Archive what the table has of an hour; returns the manifest's row, None if there is nothing."""
    topic, hour = parse_topic(pending.topic), parse_hour(pending.period)
    due_ms = archive.marks.due_ms(pending)
    key, refused = hour_key(topic, hour), refused_key(topic, hour)
    # Before the row, which may be newer than these versions and never older.
    versions = {one: archive.objects.version(one) for one in (key, refused)}
    row = archive.row(pending.topic, hour)
    unnamed = "" if versions[key] is None or (row is not None and row.key == key) else key
    with ExitStack() as files:
        file, set_aside, written = _write(archive, pending, row, now_ms, files, unnamed=unnamed)
        aside = sum(written.refused.values())
        if written.batches + aside and (row is None or row.content != written.content):
            sha256, size = "", 0
            if written.batches:
                sha256, size = archive.objects.write(key, file, versions[key])
            if aside:
                archive.objects.write(refused, set_aside, versions[refused])
            # The day's object, if there is one, is now old.
            archive.marks.add(Pending(pending.topic, hour.date), now_ms)
            before, row = (
                row,
                ArchivedHour(
                    topic=pending.topic,
                    hour=str(hour),
                    key=key if written.batches else "",
                    batches=written.batches,
                    samples=written.samples,
                    refused=aside,
                    content=written.content,
                    sha256=sha256,
                    size_bytes=size,
                    archived_ms=now_ms,
                    first_expires_s=written.first_expires_s,
                ),
            )
            archive.manifest.keep(row, before)
            emit(
                "archive",
                HoursArchived=1,
                SamplesArchived=written.samples,
                BytesArchived=size,
                ItemsSetAside=aside,
            )
        elif row is not None and written.first_expires_s != row.first_expires_s:
            # A batch that was sent twice expires by its last receipt, and the retention may be shorter now.
            before, row = row, replace(row, first_expires_s=written.first_expires_s)
            archive.manifest.keep(row, before)
    archive.marks.done(pending, due_ms, now_ms)
    return row


def _write(
    archive: Archive,
    pending: Pending,
    row: ArchivedHour | None,
    now_ms: int,
    files: ExitStack,
    *,
    unnamed: str,
) -> tuple[IO[bytes], IO[bytes], Written]:
    """Write an hour's file, and that of refused items.

    What the table no longer has comes from the archive, which must not shrink. ``unnamed`` is the key of an
    object of the hour that its row does not name: an import has written it, and not the row yet.
    """
    topic, hour = pending.topic, parse_hour(pending.period)
    is_expiring = row is not None and 0 < row.first_expires_s <= now_ms / 1000 + _MARGIN_S
    with_archived = is_expiring or bool(unnamed)
    while True:
        into, refused, scratch = [files.enter_context(TemporaryFile()) for _ in range(3)]  # noqa: SIM115 - it is
        keys = starting_between(hour.start_us, hour.end_us - 1)
        pages = archive.telemetry.pages(topic, keys)
        items: Iterator[Item] = (item for page in pages for item in page.items)
        expiries = [row.first_expires_s] if row is not None and row.first_expires_s else []
        if with_archived:
            items = _with_archived(items, archive, pending, row, files, unnamed=unnamed)
        written = write_hour(
            items,
            into,
            hour=hour,
            refused=refused,
            scratch=scratch,
            describe=described(parse_topic(topic).name),
        )
        if row is None or with_archived or written.content == row.content:
            expiries += [written.first_expires_s] if written.first_expires_s else []
            if unnamed and (row is None or written.content != row.content):
                # The table may not have what that object has, as if it had expired there.
                expiries.append(now_ms // 1000)
            return into, refused, written._replace(first_expires_s=min(expiries, default=0))
        # Something is new. Whether something is missing as well tells only the archive.
        with_archived = True


def _with_archived(
    stored: Iterator[Item],
    archive: Archive,
    pending: Pending,
    row: ArchivedHour | None,
    files: ExitStack,
    *,
    unnamed: str,
) -> Iterator[Item]:
    """The stored items of an hour, and those that only the archive has, in the order of their ids."""
    topic, hour, sources = pending.topic, parse_hour(pending.period), [stored]
    for key in filter(None, (row.key if row else "", unnamed)):
        file = files.enter_context(archive.objects.read(key).file)
        try:
            sources.append(archived_items(ArchiveFile(file), topic, hour))
        except (KeyError, OSError, TypeError, ValueError):
            if key != unnamed:
                raise
            _log.warning("%s is no object of the archive, and no row names it: it is written anew", key)
    if row is not None and row.refused:
        lines = files.enter_context(archive.objects.read(refused_key(parse_topic(topic), hour)).file)
        sources.append(iter(sorted(map(json.loads, lines), key=key_of)))
    return merged(*sources)


# Joins the hours of a day that is over to one object.
#
# The day's object is written first, then all rows of the day point to it in one transaction, then the hours'
# objects go. Killed between any two of these, the rows point to objects that are there, and the next run ends
# the work.

# Larger days stay as hours: a reader finds its hour, and nothing is won by reading and writing it again.
MOST_BYTES = 256 * 1024 * 1024
# A run has ended this long after it wrote an object; the function may take ten minutes.
WRITING_MS = 900_000


class BeingWrittenError(Exception):
    """An hour's object has been written, and not its row: its run has not ended, or must be tried again."""


def join_day(archive: Archive, pending: Pending, now_ms: int) -> bool:
    """Join the hours of a day; returns whether the day has an object of its own now."""
    topic, first = parse_topic(pending.topic), parse_hour(f"{pending.period}T00")
    hours = [Hour(first.number + i) for i in range(24)]
    due_ms = archive.marks.due_ms(pending)
    pages = archive.manifest.pages(pending.topic, hours_between(hours[0], hours[-1]))
    rows = [row for page in pages for item in page.items if (row := archived_hour(item)).key]
    key = day_key(topic, first)
    size = sum({row.key: row.size_bytes for row in rows}.values())
    joined, joins = all(row.key == key for row in rows), dict[str, str]()
    if not joined and len(rows) > 1 and size <= MOST_BYTES:
        version = archive.objects.version(key)
        with ExitStack() as files:
            found = {one: archive.objects.read(one) for one in sorted({row.key for row in rows})}
            opened = {one: ArchiveFile(files.enter_context(read.file)) for one, read in found.items()}
            for row in rows:
                if row.key != key and found[row.key].sha256 != row.sha256:
                    raise BeingWrittenError(f"{row.key} is newer than its row")
            into = files.enter_context(TemporaryFile())
            write_day(
                {parse_hour(row.hour): opened[row.key] for row in rows},
                into,
                describe=described(topic.name),
            )
            sha256, size = archive.objects.write(key, into, version)
        changes: list[Any] = []
        for row in rows:
            put = {
                "TableName": archive.manifest.name,
                "Item": replace(row, key=key, sha256=sha256, size_bytes=size).item(),
                "ConditionExpression": "content = :content AND #key = :key",
                "ExpressionAttributeNames": {"#key": "key"},
                "ExpressionAttributeValues": {":content": {"S": row.content}, ":key": {"S": row.key}},
            }
            changes.append({"Put": put})
        archive.client.transact_write_items(TransactItems=changes)
        emit("archive", DaysJoined=1)
        joined, joins = True, {one: read.etag for one, read in found.items()}
    clean = True
    if joined and rows:
        clean = _remove_hours(archive, pending.topic, [parse_hour(row.hour) for row in rows], joins, now_ms)
    if clean:
        archive.marks.done(pending, due_ms, now_ms)
    return joined


def _remove_hours(
    archive: Archive, topic: str, hours: list[Hour], joined: Mapping[str, str], now_ms: int
) -> bool:
    """Remove the objects of hours whose rows point elsewhere; returns whether all are gone.

    Before a late batch's run moves the row back, it writes the object. So only a version that is ``joined``
    goes, or one that nobody can be about to point to.
    """
    clean = True
    for hour in hours:
        key = hour_key(parse_topic(topic), hour)
        version = archive.objects.version(key)
        if version is None:
            continue
        row = archive.row(topic, hour)
        if row is None or row.key == key:
            continue
        if version.etag == joined.get(key) or version.written_ms < now_ms - WRITING_MS:
            archive.objects.remove(key, version.etag)
        else:
            clean = False
    return clean
