"""Moves robots from one deployment into another: the registry's rows, the archive, the stored batches, and
what the analysis and people have written about them.

Nothing is removed from the source. What the target has already is left as it is, so a move that was
interrupted goes on, and one that is repeated copies what has come since. Both sides are then read as
`iort audit` reads them, and compared batch by batch.
"""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from botocore.exceptions import ClientError

from iort_analysis.samples.batches import Item
from iort_contract.archive import content_hash, item_hash, parse_hour, refused_key
from iort_contract.dynamodb import WRITE_ITEMS, Keys, starting_between
from iort_contract.tables import (
    ADMISSION,
    ALERT_PREFIX,
    ASKED_PREFIX,
    BATCH,
    ENVELOPE,
    EXPIRES_S,
    FILES_BYTES,
    FILES_DAY,
    PRESENCE,
    ROBOT,
    SERIAL,
    STREAMS,
)
from iort_contract.topics import parse_topic
from iort_station.cloud import Cloud
from iort_station.data.analysis import findings
from iort_station.data.archive import Archive, key_of
from iort_station.data.batches import ahead, telemetry_table, topic_of
from iort_station.data.recorded import Recorded
from iort_station.errors import StationError
from iort_station.fleet import registry, robots, tags
from iort_station.operations.delivery.audit import Audit, audit, headers
from iort_station.recordings.adopt import UNITS_PER_S, write

# What a registry's row says of the deployment and not of the robot.
_STAYS = frozenset({ROBOT, FILES_DAY, FILES_BYTES, *PRESENCE, *ADMISSION}) - {SERIAL}
_COUNTERS = (ALERT_PREFIX, ASKED_PREFIX)

# Receives the number of batches read.
Progress = Callable[[int], None]


def _nobody(_batches: int) -> None:
    """Tell nobody."""


class Copied(NamedTuple):
    """What was copied of a stream; the rest was there already. Hours are ``left`` whose object would replace
    another one, with hours of the target's own."""

    hours: int
    batches: int
    left: int


class Side(NamedTuple):
    """A stream as one deployment has it: its batches, the hash over their contents, and its audit."""

    batches: int
    content: str
    audit: Audit


@dataclass(frozen=True)
class Compared:
    """A stream on both sides. ``problem`` is empty if they are the same."""

    source: Side
    target: Side

    @property
    def problem(self) -> str:
        """How they differ."""
        source, target = self.source, self.target
        if source.batches != target.batches:
            return f"the source has {source.batches:,} batches, the target {target.batches:,}: move again"
        if source.content != target.content:
            return "the contents differ"
        return "" if source.audit == target.audit else "the audits differ"


def check(source: Cloud, target: Cloud) -> None:
    """Raise `StationError` unless robots can be moved between these deployments."""
    if source.namespace != target.namespace:
        raise StationError(
            f"both deployments must have one namespace, got {source.namespace} and {target.namespace}: "
            "it is part of every topic"
        )
    if _place(source) == _place(target):
        raise StationError("the target is the source itself")


def _place(cloud: Cloud) -> tuple[str, ...]:
    """Where a deployment is. Two profiles may be of one account."""
    if cloud.endpoint_url is not None:
        return (cloud.endpoint_url,)
    return cloud.client("sts").get_caller_identity()["Account"], cloud.region_name or ""


def register(source: Cloud, target: Cloud, robot: str, bundles: Path | None = None) -> bool:
    """Register a robot in the target with what the source knows of it; False if it was there already.

    With ``bundles`` it gets a certificate there, in the bundle ``bundles/<robot>``; otherwise it claims one.
    A robot that the source has removed stays removed.
    """
    row = registry.find(source, robot)
    if row is None:
        return False
    if registry.find(target, robot) is not None:
        return False
    if bundles is not None:
        robots.add(target, robot, out=bundles, vehicle=_carried(row))
    else:
        registry.enter(target, robot, _carried(row))
    return True


def copy_tags(source: Cloud, target: Cloud, names: Sequence[str]) -> None:
    """Copy the tags of robots that have a thing in the target: the others have yet to claim their names."""
    old, new = tags.listed(source), tags.listed(target)
    for robot in names:
        wanted = old.get(robot, {})
        if robot in new and not wanted.items() <= new[robot].items():
            tags.change(target, robot, dict(wanted))


def _carried(row: Mapping[str, Any]) -> dict[str, Any]:
    kept = {
        name: value
        for name, value in row.items()
        if name not in _STAYS and not name.startswith(_COUNTERS) and value is not None
    }
    # DynamoDB has no empty set.
    return {**kept, **({STREAMS: set(kept[STREAMS])} if STREAMS in kept else {})}


def copy_findings(source: Cloud, target: Cloud, robot: str) -> int:
    """Copy the findings, analysed drives and notes of a robot that the target lacks; returns how many."""
    old, new = findings.table(source), findings.table(target)
    # The target may have analysed a drive again, with all of its batches.
    analysed, there = ({one.drive for one in new.drives(robot)}, {note.id for note in new.notes(robot)})
    count = 0
    for finding in old.findings(robot):
        if finding.drive not in analysed:
            new.put_finding(finding)
            count += 1
    # After its findings: a move that ends between them goes on.
    for drive in old.drives(robot):
        if drive.drive not in analysed:
            new.put_drive(drive)
            count += 1
    for note in old.notes(robot):
        if note.id not in there:
            new.put_note(note)
            count += 1
    return count


def copy(
    source: Cloud,
    target: Cloud,
    robot: str,
    stream: str,
    *,
    units_per_s: int = UNITS_PER_S,
    progress: Progress = _nobody,
) -> Copied:
    """Copy what the target lacks of a stream, at so many write units a second.

    Raises `StationError` if an object is not the one that the source's manifest names, or if DynamoDB rejects
    a write. What was copied until then is good.
    """
    topic = topic_of(source, robot, stream)
    hours, left = _copy_archive(source, target, topic)
    table, batches = telemetry_table(target), 0
    for items in ahead(page.items for page in telemetry_table(source).pages(topic)):
        new = list(_lacking(target, topic, items))
        for start in range(0, len(new), WRITE_ITEMS):
            write(table, new[start : start + WRITE_ITEMS], units_per_s)
        batches += len(new)
        progress(len(items))
    return Copied(hours, batches, left)


def _lacking(target: Cloud, topic: str, items: Sequence[Item]) -> Iterator[Item]:
    """The items that the target does not have, and that DynamoDB is not about to delete."""
    if not items:
        return
    keys = Keys(items[0][BATCH], items[-1][BATCH], empty=False)
    pages = telemetry_table(target).pages(topic, keys, attributes=(BATCH,))
    there = {key_of(item) for page in pages for item in page.items}
    now_s = time.time()
    for item in items:
        if key_of(item) not in there and int(item.get(EXPIRES_S, {"N": now_s + 1})["N"]) > now_s:
            yield item


def _copy_archive(source: Cloud, target: Cloud, topic: str) -> tuple[int, int]:
    """Copy the hours of the archive that the target lacks; the manifest's row comes last. Returns how many,
    and how many are left."""
    # An hour that both have is made by each from its own table; `compare` tells if one lacks something.
    rows = list(Archive(target, topic).rows())
    there, objects = {row.hour for row in rows}, {row.key: row.sha256 for row in rows}
    copied = left = 0
    copies = _Objects(source, target)
    for row in Archive(source, topic).rows():
        if row.hour in there:
            continue
        if row.key and objects.get(row.key, row.sha256) != row.sha256:
            left += 1
            continue
        if row.key:
            copies.copy(row.key, row.sha256)
        if row.refused:
            copies.copy(refused_key(parse_topic(topic), parse_hour(row.hour)))
        target.client("dynamodb").put_item(
            TableName=target.output("storage", "ArchiveTable"), Item=row.item()
        )
        copied += 1
    return copied, left


class _Objects:
    """Copies the archive's objects, each once: a day's hours are in one."""

    def __init__(self, source: Cloud, target: Cloud) -> None:
        self._from, self._to = source.client("s3"), target.client("s3")
        self._source, self._target = (one.output("storage", "FilesBucket") for one in (source, target))
        self._copied: set[str] = set()

    def copy(self, key: str, sha256: str | None = None) -> None:
        if key in self._copied:
            return
        try:
            content = self._from.get_object(Bucket=self._source, Key=key)["Body"].read()
        except ClientError as error:
            raise StationError(f"{key} cannot be read: {error.response['Error']['Code']}") from error
        if sha256 is not None and hashlib.sha256(content).hexdigest() != sha256:
            raise StationError(f"{key} is not the object that was archived: run `iort archive verify`")
        self._to.put_object(Bucket=self._target, Key=key, Body=content)
        self._copied.add(key)


def compare(source: Cloud, target: Cloud, robot: str, stream: str, progress: Progress = _nobody) -> Compared:
    """Read a stream on both sides, wherever its batches are, and compare them."""
    return Compared(*(_side(cloud, robot, stream, progress) for cloud in (source, target)))


def _side(cloud: Cloud, robot: str, stream: str, progress: Progress) -> Side:
    count = 0

    def hashes() -> Iterator[tuple[str, str]]:
        nonlocal count
        pages = Recorded(cloud, robot, stream).items(starting_between(None, None), ENVELOPE)
        for items in pages:
            count += len(items)
            progress(len(items))
            yield from ((key_of(item), item_hash(dict(item))) for item in items)

    content = content_hash(hashes())
    return Side(count, content, audit(stream, headers(cloud, robot, stream)))
