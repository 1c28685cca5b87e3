"""The cloud of an `iort` command, from the options before its name."""

from __future__ import annotations

import os
import socket
from dataclasses import dataclass, replace
from pathlib import Path
from urllib.parse import urlsplit

from botocore.exceptions import BotoCoreError

from iort_station import kept
from iort_station.cli.words import say
from iort_station.cloud import EMBEDDED, EMBEDDED_VARIABLE, Cloud, find_embedded
from iort_station.errors import StationError

# Who has set one of these wants an AWS account.
_AWS_NAMED = ("AWS_PROFILE", "AWS_REGION", "AWS_DEFAULT_REGION", "AWS_ACCESS_KEY_ID")
# It runs on this machine.
_CONNECT_S = 5.0


@dataclass
class CloudOptions:
    """The options that select a cloud; commands read it from ``context.obj``."""

    namespace: str
    profile: str | None
    region: str | None
    local: bool
    embedded: Path | None

    def cloud(self) -> Cloud:
        """The selected cloud: an embedded one that runs here, unless an option or variable selects AWS.

        Raises `StationError` if none runs and AWS' credentials are missing.
        """
        said = self.profile or self.region or any(os.environ.get(name) for name in _AWS_NAMED)
        embedded = self.file()
        if self.local and embedded is None:
            raise StationError(
                f"no embedded cloud is running: {Path.cwd()} and the folders above it have no {EMBEDDED}, "
                f"and {kept.folder()} no {kept.CLOUD}. `make up` or `make demo` starts one in a checkout of "
                f"iort; --embedded or {EMBEDDED_VARIABLE} names its file from anywhere else"
            )
        if embedded and (self.local or (not said and embedded.exists())):
            cloud = _alive(Cloud.load(embedded), embedded)
            if not self.local:
                say(f"on the embedded cloud of {embedded}")
            return cloud
        cloud = Cloud(namespace=self.namespace, profile=self.profile, region=self.region)
        try:
            return cloud.check()
        except StationError as error:
            if said:
                raise
            raise StationError(
                f"{error}. No embedded cloud runs here either; `make up` or `make demo` starts one"
            ) from error

    def file(self) -> Path | None:
        """The file of the embedded cloud that is named, or that runs here; None if there is none."""
        return self.embedded or find_embedded(Path.cwd()) or _kept()

    def means_kept(self, folder: Path) -> bool:
        """Whether the cloud of `make up` in this folder is meant: it is up, or was killed."""
        if self.embedded is not None:
            return self.embedded.absolute().parent == folder
        said = self.profile or self.region or any(os.environ.get(name) for name in _AWS_NAMED)
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


def _kept() -> Path | None:
    """The file of the cloud of `make up`; None if it is not up."""
    path = kept.folder() / kept.CLOUD
    return path if path.is_file() else None


def _alive(cloud: Cloud, path: Path) -> Cloud:
    """The embedded cloud; raises `StationError` if it has ended without removing its file."""
    address = urlsplit(cloud.endpoint_url or "")
    try:
        socket.create_connection((address.hostname or "", address.port or 0), _CONNECT_S).close()
    except OSError as error:
        raise StationError(
            f"the embedded cloud of {path} does not answer: was it killed? `make up` or `make "
            "demo` starts one"
        ) from error
    return cloud
