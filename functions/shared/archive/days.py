"""Joins the hours of a day that is over to one object.

The day's object is written first, then all rows of the day point to it in one transaction, then the hours'
objects go. Killed between any two of these, the rows point to objects that are there, and the next run ends
the work.
"""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import ExitStack
from tempfile import TemporaryFile
from typing import Any

from functions.shared.archive.archive import Archive
from functions.shared.metrics import emit
from iort_analysis.archive.reading import ArchiveFile
from iort_analysis.archive.writing import described, write_day
from iort_contract.archive import Hour, Pending, archived_hour, day_key, hour_key, hours_between, parse_hour
from iort_contract.topics import parse_topic

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
        etag = archive.objects.etag(key)
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
            stored = archive.objects.write(key, into, etag)
        changes: list[Any] = []
        for row in rows:
            item = {**row.item(), "key": {"S": key}}
            item.update({"sha256": {"S": stored.sha256}, "size_bytes": {"N": str(stored.size)}})
            changes.append(
                {
                    "Put": {
                        "TableName": archive.manifest.name,
                        "Item": item,
                        "ConditionExpression": "content = :content AND #key = :key",
                        "ExpressionAttributeNames": {"#key": "key"},
                        "ExpressionAttributeValues": {
                            ":content": {"S": row.content},
                            ":key": {"S": row.key},
                        },
                    }
                }
            )
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
