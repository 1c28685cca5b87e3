"""The archive's operation: what it holds, whether it is whole, and running it now."""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Literal

from botocore.exceptions import ClientError

from iort_analysis.archive.reading import ArchiveFile
from iort_contract.archive import (
    ALL,
    HOUR_REST_MS,
    HOUR_US,
    SWEEP,
    TASK,
    ArchivedHour,
    content_hash,
    item_hash,
    parse_hour,
    refused_key,
    stored_hours,
)
from iort_contract.dynamodb import starting_between
from iort_contract.tables import BATCH, SAMPLES, TOPIC
from iort_contract.topics import parse_topic
from iort_station.cloud import Cloud
from iort_station.data import inventory
from iort_station.data.stored.batches import telemetry_table, topic_of
from iort_station.data.stored.recorded import archive_of
from iort_station.errors import StationError
from iort_station.fleet import registry

# The schedule archives an hour at most this long after its end.
_DUE_US = 2 * HOUR_US
# A task takes at most ten minutes.
_STALLED_S, _POLL_S = 660.0, 1.0


@dataclass
class Verified:
    """A stream's archive: its hours and samples, and by hour what is wrong."""

    hours: int = 0
    samples: int = 0
    problems: dict[str, str] = field(default_factory=dict)


def topics(cloud: Cloud, robot: str | None, stream: str | None) -> list[str]:
    """The topics of a robot's streams, or of every registered robot's."""
    robots = [registry.checked(robot)] if robot else sorted(row["robot"] for row in registry.listed(cloud))
    return [
        topic_of(cloud, one, name)
        for one in robots
        for name in ([stream] if stream else inventory.known(cloud, one))
    ]


def run(cloud: Cloud, topic: str) -> int:
    """Queue what is over and not archived of a stream; returns the number of hours."""
    task = {TASK: SWEEP, TOPIC: topic, ALL: True}
    name = cloud.output("archive", "ArchiveFunction")
    reply = cloud.client("lambda").invoke(FunctionName=name, Payload=json.dumps(task))
    answer = json.loads(reply["Payload"].read())
    if "FunctionError" in reply:
        raise StationError(f"the archive's function failed: {answer.get('errorMessage', answer)}")
    return int(answer["tasks"])


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


def verify(cloud: Cloud, topic: str) -> Verified:
    """Compare a stream's table, manifest and objects; everything in the archive is read."""
    found = Verified()
    table = telemetry_table(cloud)
    objects = _Objects(cloud)
    archived = {row.hour: row for row in archive_of(cloud, topic).rows()}
    until_us = time.time_ns() // 1000 - HOUR_REST_MS * 1000
    stored = [str(hour) for hour in stored_hours(table, topic, until_us)]
    for name in sorted({*archived, *stored}):
        hour, known = parse_hour(name), dict[str, str]()
        if (row := archived.get(name)) is not None:
            found.hours += 1
            found.samples += row.samples
            try:
                known = objects.hashes(row)
            except StationError as error:
                found.problems[name] = str(error)
                continue
        if name in stored:
            keys = starting_between(hour.start_us, hour.end_us - 1)
            items = (item for page in table.pages(topic, keys) for item in page.items)
            missing = sum(known.get(item[BATCH]["S"]) != item_hash(item) for item in items)
            if missing and hour.end_us + _DUE_US < until_us:
                found.problems[name] = f"{missing} batches are not archived"
    return found


class _Objects:
    """The archive's objects, the last one kept: a day's hours are in one."""

    def __init__(self, cloud: Cloud) -> None:
        self._client, self._bucket = cloud.client("s3"), cloud.output("storage", "FilesBucket")
        self._file = lru_cache(maxsize=1)(self._read)

    def hashes(self, row: ArchivedHour) -> dict[str, str]:
        """The hashes of an hour's items by their ids; raises `StationError` if the row says otherwise."""
        hour = parse_hour(row.hour)
        hashes: dict[str, str] = {}
        samples = 0
        if row.key:
            file = self._file(row.key, row.sha256)
            hashes = dict(file.hashes(hour))
            samples = sum(int(item[SAMPLES]["N"]) for item in file.headers(hour))
        counts = (len(hashes), samples)
        if row.refused:
            lines = self._get(refused_key(parse_topic(row.topic), hour)).splitlines()
            hashes.update({item[BATCH]["S"]: item_hash(item) for item in map(json.loads, lines)})
        if content_hash(sorted(hashes.items())) != row.content or counts != (row.batches, row.samples):
            raise StationError(f"{row.key or row.hour} does not hold what the manifest says")
        return hashes

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
