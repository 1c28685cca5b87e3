"""The archive's operation: what it holds, whether it is whole, and running it now."""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from itertools import groupby, islice
from typing import Literal

from botocore.exceptions import ClientError

from iort_analysis.archive.hours import DAMAGED, Archive, key_of
from iort_analysis.archive.reading import ArchiveFile
from iort_analysis.samples.batches import Item, RefusedItems, part
from iort_contract import archive
from iort_contract.tables import TOPIC
from iort_contract.topics import parse_topic
from iort_station.cloud import Cloud, invoke
from iort_station.data import inventory
from iort_station.data.recorded import stores, telemetry_table, topic_of
from iort_station.errors import StationError
from iort_station.fleet import registry

# The schedule archives an hour at most this long after its end.
_DUE_US = 2 * archive.HOUR_US
# A task takes at most ten minutes.
_STALLED_S, _POLL_S = 660.0, 1.0
# So many items are decoded together.
_TOGETHER = 200


@dataclass
class Verified:
    """What a stream has stored: its archive's hours and samples, and the ``items`` of its table.

    By hour, ``lacking`` has the number of batches that are not archived, though they should be, and
    ``damaged`` what is wrong with what is. ``refused`` counts and names what no reader can decode.
    """

    hours: int = 0
    samples: int = 0
    items: int = 0
    lacking: dict[str, int] = field(default_factory=dict)
    damaged: dict[str, str] = field(default_factory=dict)
    refused: RefusedItems = field(default_factory=RefusedItems)


def topics(cloud: Cloud, robot: str | None, stream: str | None) -> list[str]:
    """The topics of a robot's streams, or of every registered robot's."""
    robots = [registry.checked(robot)] if robot else sorted(row["robot"] for row in registry.listed(cloud))
    return [
        topic_of(cloud, one, name)
        for one in robots
        for name in ([stream] if stream else inventory.known(cloud, one))
    ]


def archived_topics(cloud: Cloud) -> set[str]:
    """The topics in the manifest, also those of robots that were removed."""
    pages = (
        cloud.client("dynamodb")
        .get_paginator("scan")
        .paginate(
            TableName=cloud.output("storage", "ArchiveTable"),
            ProjectionExpression="#topic",
            ExpressionAttributeNames={"#topic": TOPIC},
        )
    )
    return {item[TOPIC]["S"] for page in pages for item in page["Items"]} - set(archive.PENDING)


def run(cloud: Cloud, topic: str) -> int:
    """Queue what is over and not archived of a stream; returns the number of hours."""
    task = {archive.TASK: archive.SWEEP, TOPIC: topic, archive.ALL: True}
    event = json.dumps(task).encode()
    answer = invoke(cloud, "archive", "ArchiveFunction", event, "the archive's function")
    return int(json.loads(answer)["tasks"])


def wait(cloud: Cloud, progress: Callable[[int], None]) -> None:
    """Wait until the archive's queue is empty; ``progress`` gets the number of tasks in it.

    Raises `StationError` if nothing has been done for longer than a task may take.
    """
    url = cloud.output("archive", "ArchiveTasksQueue")
    waiting: Literal["ApproximateNumberOfMessages"] = "ApproximateNumberOfMessages"
    running: Literal["ApproximateNumberOfMessagesNotVisible"] = "ApproximateNumberOfMessagesNotVisible"
    left, since = -1, time.monotonic()
    while left:
        answer = cloud.client("sqs").get_queue_attributes(QueueUrl=url, AttributeNames=[waiting, running])
        now = int(answer["Attributes"][waiting]) + int(answer["Attributes"][running])
        if now != left:
            left, since = now, time.monotonic()
            progress(left)
        elif time.monotonic() - since > _STALLED_S:
            raise StationError(f"{left} tasks of the archive fail: its function's log says why")
        if left:
            time.sleep(_POLL_S)


def verify(cloud: Cloud, topic: str, progress: Callable[[int], None] = lambda _items: None) -> Verified:
    """Read and decode all that is stored of a stream, and compare its table, manifest and objects.

    ``progress`` gets the number of further items read.
    """
    found = Verified(refused=RefusedItems(topic))
    objects = _Objects(cloud)
    rows = {row.hour: row for row in Archive(stores(cloud), topic, found.refused).rows()}
    due_us = time.time_ns() // 1000 - archive.HOUR_REST_MS * 1000 - _DUE_US
    pages = telemetry_table(cloud).pages(topic)
    for hour, items in groupby((item for page in pages for item in page.items), key=_hour_of):
        archived = _archived(objects, rows.pop(str(hour), None), found, progress)
        there: set[str] = set()
        lacking, other = 0, list[str]()
        while some := list(islice(items, _TOGETHER)):
            part(some, found.refused)
            for item in some:
                key = key_of(item)
                there.add(key)
                if archived is not None:
                    lacking += key not in archived.hashes
                    if archived.hashes.get(key) not in {None, archive.item_hash(dict(item))}:
                        other.append(key)
            found.items += len(some)
            progress(len(some))
        if hour is not None and hour.end_us < due_us and lacking:
            found.lacking[str(hour)] = lacking
        if other:
            found.damaged[str(hour)] = (
                f"{len(other)} batches in the table are not as they were archived; the first is {other[0]}"
            )
        _refused(archived, there, found)
    for row in rows.values():
        _refused(_archived(objects, row, found, progress), set(), found)
    return found


def _hour_of(item: Item) -> archive.Hour | None:
    """The hour of an item's key; None if a key begins with no time, which the archive passes over."""
    start = key_of(item)[:16]
    return archive.hour_of(int(start)) if len(start) == 16 and start.isascii() and start.isdigit() else None


@dataclass
class _Archived:
    """What the archive has of an hour: the hashes of its items by their ids, and what was no batch."""

    hashes: Mapping[str, str] = field(default_factory=dict)
    refused: Sequence[Item] = ()


def _archived(
    objects: _Objects, row: archive.ArchivedHour | None, found: Verified, progress: Callable[[int], None]
) -> _Archived | None:
    """None if the hour's object is not what the manifest says, which is said then."""
    if row is None:
        return _Archived()
    found.hours += 1
    found.samples += row.samples
    try:
        return objects.archived(row)
    except StationError as error:
        found.damaged[row.hour] = str(error)
        return None
    finally:
        progress(row.batches + row.refused)


def _refused(archived: _Archived | None, there: set[str], found: Verified) -> None:
    """Name what was archived without being a batch, and is not in the table any more."""
    if archived is not None:
        part([item for item in archived.refused if key_of(item) not in there], found.refused)


class _Objects:
    """The archive's objects, the last one kept: a day's hours are in one."""

    def __init__(self, cloud: Cloud) -> None:
        self._client, self._bucket = cloud.client("s3"), cloud.output("storage", "FilesBucket")
        self._file = lru_cache(maxsize=1)(self._read)

    def archived(self, row: archive.ArchivedHour) -> _Archived:
        """Decode an hour; raises `StationError` if it is damaged, or is not what the row says."""
        what = row.key or row.hour
        try:
            return self._decoded(row, what)
        except DAMAGED as error:
            raise StationError(f"{what} is damaged: {error}") from error

    def _decoded(self, row: archive.ArchivedHour, what: str) -> _Archived:
        hour = archive.parse_hour(row.hour)
        hashes: dict[str, str] = {}
        samples, refused = 0, list[Item]()
        if row.key:
            file = self._file(row.key, row.sha256)
            hashes = dict(file.hashes(hour))
            samples = sum(len(one.block.times_us) for one in file.pages(hour))
        counts = (len(hashes), samples)
        if row.refused:
            lines = self._get(archive.refused_key(parse_topic(row.topic), hour)).splitlines()
            refused = [json.loads(line) for line in lines]
            hashes.update({key_of(item): archive.item_hash(dict(item)) for item in refused})
        if archive.content_hash(sorted(hashes.items())) != row.content or counts != (
            row.batches,
            row.samples,
        ):
            raise StationError(f"{what} does not hold what the manifest says")
        return _Archived(hashes, refused)

    def _read(self, key: str, sha256: str) -> ArchiveFile:
        content = self._get(key)
        if hashlib.sha256(content).hexdigest() != sha256:
            raise StationError(f"{key} is not the object that was written")
        return ArchiveFile(content)

    def _get(self, key: str) -> bytes:
        try:
            return bytes(self._client.get_object(Bucket=self._bucket, Key=key)["Body"].read())
        except ClientError as error:
            raise StationError(f"{key} cannot be read: {error.response['Error']['Code']}") from error
