"""What the doctor finds in everything that is stored: all of it is read and decoded."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

from iort_contract.topics import parse_topic
from iort_station.cloud import Cloud
from iort_station.fleet import files
from iort_station.fleet.files import StoredFile
from iort_station.operations import archive
from iort_station.times import iso_s
from iort_station.upkeep.finding import FAIL, OK, WARN, Finding

# Receives the number of further items or bytes that were read.
Progress = Callable[[int], None]
_LOST = "readers leave it out, and say so; an older backup may have it"
_ARCHIVE = "readers take what the table still has of this hour; an older backup may have it"
_FILE = "it cannot be fetched; an older backup may have it, or the robot"


def topics(cloud: Cloud) -> list[str]:
    """The topics of all streams: of registered robots, and of removed ones whose recordings are archived."""
    return sorted({*archive.topics(cloud, None, None), *archive.archived_topics(cloud)})


def of_recordings(cloud: Cloud, names: Sequence[str], progress: Progress) -> Iterator[Finding]:
    """Read these topics' batches in the table, and the hours in the archive. Each that is damaged is a
    finding; the first ones of a stream are named."""
    items = hours = damaged = 0
    for name in names:
        found = archive.verify(cloud, name, progress)
        topic = parse_topic(name)
        what = f"{topic.robot} {topic.name}"
        items += found.items
        hours += found.hours
        damaged += len(found.damaged) + found.refused.count
        for hour, count in found.lacking.items():
            yield Finding(
                what, WARN, f"{count:,} batches of {hour} are in the table only", "`iort archive run`"
            )
        for hour, problem in found.damaged.items():
            yield Finding(what, FAIL, f"in the archive's hour {hour}: {problem}", _ARCHIVE)
        for one in found.refused.named:
            yield Finding(what, FAIL, f"cannot be decoded: {one.removeprefix(f'{name} ')}", _LOST)
        if (more := found.refused.count - len(found.refused.named)) > 0:
            yield Finding(what, FAIL, f"{more:,} more cannot be decoded", _LOST)
    if not damaged:
        text = f"{items:,} items of the table and {hours:,} hours of the archive can be decoded"
        yield Finding("recordings", OK, text)


def of_files(cloud: Cloud, listed: Sequence[StoredFile], progress: Progress) -> Iterator[Finding]:
    """Read the robots' files, and compare each with the SHA-256 that the robot gave.

    On AWS they are not read: S3 checks their bytes itself, and fetching them costs money.
    """
    size = f"{len(listed):,} files, {sum(one.size for one in listed) / 1e9:,.1f} GB"
    if cloud.endpoint_url is None:
        yield Finding("files", OK, f"{size}: S3 checks their bytes itself, so they were not fetched")
        return
    damaged = 0
    for one in listed:
        if problem := files.damage(cloud, one, progress):
            damaged += 1
            at = iso_s(one.second * 1_000_000)
            yield Finding(f"{one.robot} {one.name}", FAIL, f"of {at}, {one.key}: {problem}", _FILE)
    if not damaged:
        yield Finding("files", OK, f"{size}, as the robots sent them")
