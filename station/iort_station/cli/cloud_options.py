"""The cloud of an `iort` command, from the options before its name."""

from __future__ import annotations

import os
from dataclasses import asdict, dataclass, replace
from pathlib import Path

from botocore.exceptions import BotoCoreError

from iort_station import kept
from iort_station.cli.words import say
from iort_station.cloud import AWS_NAMED, Cloud, embedded_here, find_embedded
from iort_station.errors import StationError


@dataclass
class CloudOptions:
    """The options that select a cloud; commands read it from ``context.obj``."""

    namespace: str
    profile: str | None
    region: str | None
    local: bool
    embedded: Path | None

    def cloud(self) -> Cloud:
        """The selected cloud, which is said on standard error: see `Cloud.find`."""
        return Cloud.find(**asdict(self), say=say)

    def file(self) -> Path | None:
        """The file of the embedded cloud that is named, or that runs here; None if there is none."""
        return self.embedded or embedded_here()

    def means_kept(self, folder: Path) -> bool:
        """Whether the cloud of `make up` in this folder is meant: it is up, or was killed."""
        if self.embedded is not None:
            return self.embedded.absolute().parent == folder
        said = self.profile or self.region or any(os.environ.get(name) for name in AWS_NAMED)
        there = (folder / kept.UP).exists()
        return there and (self.local or not said) and find_embedded(Path.cwd()) is None

    def account(self, *, region: str) -> Cloud:
        """An AWS account, never an embedded cloud; ``region`` is the default.

        Raises `StationError` if the options select the embedded cloud, or if credentials are missing.
        """
        if self.local:
            raise StationError("only AWS has this, and --local selects the embedded cloud")
        cloud = Cloud(namespace=self.namespace, profile=self.profile, region=self.region)
        try:
            named = cloud.region_name
        except BotoCoreError as error:
            raise StationError(f"AWS: {error}") from error
        return replace(cloud, region=named or region).check()
