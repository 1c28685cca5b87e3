"""A deployment's recordings, for the one reader of table and archive."""

from __future__ import annotations

from contextlib import suppress

from iort_analysis.archive.hours import Archive, Stores
from iort_analysis.archive.stored import AUTO, Origin, Source, Stored
from iort_analysis.samples.batches import RefusedItems
from iort_contract.archive import ArchiveTable
from iort_station.cloud import Cloud
from iort_station.data.stored.batches import telemetry_table, topic_of
from iort_station.errors import StationError


class Recorded(Stored):
    """The batches of a robot's stream. ``origin`` and ``refused`` grow while they are read."""

    def __init__(
        self,
        cloud: Cloud,
        robot: str,
        stream: str,
        *,
        source: Source = AUTO,
        origin: Origin | None = None,
        refused: RefusedItems | None = None,
    ) -> None:
        topic = topic_of(cloud, robot, stream)
        super().__init__(stores(cloud), topic, source=source, origin=origin, refused=refused)


def archive_of(cloud: Cloud, topic: str) -> Archive:
    """The archive of a topic."""
    return Archive(stores(cloud), topic)


def stores(cloud: Cloud) -> Stores:
    """Where a deployment's recordings are. One from before the archive has no table of it."""
    manifest = None
    with suppress(StationError):
        manifest = ArchiveTable(cloud.client("dynamodb"), cloud.output("storage", "ArchiveTable"))
    return Stores(
        telemetry_table(cloud), manifest, lambda: (cloud.client("s3"), cloud.output("storage", "FilesBucket"))
    )
