"""The live page: its files, its configuration with PubNub's keys, and its publication on the web.

``npm run build`` makes the files from station/web into the folder `built`; `iort_station.page.server` serves
them. PubNub's keys are kept encrypted in Parameter Store; only `live` and the operator read them.
"""

from __future__ import annotations

import json
import math
import re
import time
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, cast

from botocore.exceptions import ClientError

from iort_contract.cloud import PUBNUB, pubnub_parameter
from iort_contract.limits import ContractError
from iort_contract.messages.page import Config, Identity, TrackMap
from iort_contract.page import PUBNUB_ORIGIN
from iort_contract.topics import check_namespace, check_robot
from iort_contract.track import Track, parse_track
from iort_station.cloud import Cloud
from iort_station.errors import StationError

if TYPE_CHECKING:
    from types_boto3_s3 import S3Client
    from types_boto3_s3.type_defs import ObjectIdentifierTypeDef

BUILT = Path(str(files("iort_station.page") / "built"))
TYPES = {
    ".html": "text/html; charset=utf-8",
    ".css": "text/css; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
    ".map": "application/json",
    ".json": "application/json",
    ".svg": "image/svg+xml",
    ".txt": "text/plain; charset=utf-8",
}

# The action that gives a driver's address.
DRIVE = "drive"
_KEY = re.compile(r"[A-Za-z0-9_-]{1,128}")
_TOKEN = re.compile(r"[A-Za-z0-9_=-]{1,4096}")
_ORIGIN = re.compile(r"([A-Za-z0-9.-]{1,253}|\[[0-9A-Fa-f:]{2,45}\])(:[0-9]{1,5})?")


def built_files(built: Path = BUILT) -> dict[str, bytes]:
    """Every file of the built page, by its path; raises `StationError` if the page is not built."""
    index = built / "index.html"
    if not index.is_file():
        raise StationError(f"the live page is not built ({index} is missing): run `make setup`")
    return {
        path.relative_to(built).as_posix(): path.read_bytes()
        for path in sorted(built.rglob("*"))
        if path.is_file() and path.suffix in TYPES
    }


def config(
    *,
    namespace: str,
    live: Literal["pubnub", "iot"] = "pubnub",
    identity: Identity | None = None,
    subscribe_key: str = "",
    origin: str = PUBNUB_ORIGIN,
    tls: bool = True,
    vehicles: Mapping[str, Mapping[str, float]] | None = None,
    token: str = "",
    answers: bool = False,
    actions: Iterable[str] = (),
    keyed: Iterable[str] = (),
    invite: str = "",
    track: Track | None = None,
) -> Config:
    """The page's ``/config.json``; raises `StationError` for a value that the page must not have.

    ``vehicles`` maps a robot to its parameters; with ``speed_to_erpm_gain`` (and ``_offset``) the page shows
    the speed in m/s instead of the motor's erpm. ``token`` is an access token of PubNub that may only read.
    A page with ``live="iot"`` has nothing of PubNub.
    """
    try:
        check_namespace(namespace)
        known = {check_robot(robot): dict(car) for robot, car in (vehicles or {}).items()}
    except ContractError as error:
        raise StationError(f"the page's configuration: {error}") from error
    if live == PUBNUB and not _KEY.fullmatch(subscribe_key):
        raise StationError("the page's subscribe_key must be 1 to 128 of A-Z a-z 0-9 _ -")
    if subscribe_key.startswith(("pub-c-", "sec-c-")):
        raise StationError("the page's subscribe_key must not be a publish or secret key")
    if token and not _TOKEN.fullmatch(token):
        raise StationError("the page's access token must be one of PubNub's grants, up to 4096 characters")
    if not _ORIGIN.fullmatch(origin):
        raise StationError(f"the page's origin must be a host, or host:port, got {origin!r}")
    for robot, car in known.items():
        if not all(map(math.isfinite, car.values())) or car.get("speed_to_erpm_gain") == 0:
            raise StationError(f"{robot} must have numbers, and a speed_to_erpm_gain other than 0, got {car}")
    return {
        "namespace": namespace,
        "live": live,
        "identity": identity,
        "drivers": DRIVE in actions,
        "subscribe_key": subscribe_key,
        "origin": origin,
        "tls": tls,
        "vehicles": known,
        "token": token,
        "answers": answers,
        "actions": sorted(actions),
        "keyed": sorted(keyed),
        "invite": invite,
        "track": None if track is None else cast("TrackMap", asdict(track)),
    }


@dataclass(frozen=True, kw_only=True)
class PubNubKeys:
    """A key set; ``origin`` and ``tls`` select a server other than PubNub's own."""

    publish_key: str = field(repr=False)
    subscribe_key: str = field(repr=False)
    origin: str = ""
    tls: bool = True

    def reading(self) -> dict[str, Any]:
        """Keyword arguments for a listener or a page: the subscribe key, and a server other than PubNub's."""
        server = {"origin": self.origin, "tls": self.tls} if self.origin else {}
        return {"subscribe_key": self.subscribe_key, **server}


def typed_keys(publish_key: str, subscribe_key: str) -> PubNubKeys:
    """Check keys of PubNub's own servers that somebody typed.

    Raises `StationError` for any other text, without repeating it: it may be the secret key.
    """
    keys = {"publish": publish_key.strip(), "subscribe": subscribe_key.strip()}
    for kind, key in keys.items():
        if not key.startswith(f"{kind[:3]}-c-"):
            raise StationError(f"the {kind} key must be {kind[:3]}-c-..., as PubNub's admin portal shows it")
    return PubNubKeys(publish_key=keys["publish"], subscribe_key=keys["subscribe"])


def store_keys(cloud: Cloud, keys: PubNubKeys) -> None:
    """Write the keys, in place of stored ones."""
    value = {"publish_key": keys.publish_key, **keys.reading()}
    cloud.client("ssm").put_parameter(
        Name=pubnub_parameter(cloud.namespace), Value=json.dumps(value), Type="SecureString", Overwrite=True
    )


def load_keys(cloud: Cloud) -> PubNubKeys:
    """Read the keys; raises `StationError` if none are stored."""
    ssm, name = cloud.client("ssm"), pubnub_parameter(cloud.namespace)
    try:
        answer = ssm.get_parameter(Name=name, WithDecryption=True)
    except ssm.exceptions.ParameterNotFound as error:
        raise StationError("PubNub's keys are not stored yet: run `iort pubnub`") from error
    try:
        return PubNubKeys(**json.loads(answer["Parameter"]["Value"]))
    except (TypeError, ValueError) as error:
        raise StationError(f"parameter {name} does not hold PubNub's keys") from error


def load_track(file: Path) -> Track:
    """The track of a CSV file; raises `StationError` for another file."""
    try:
        return parse_track(file.read_text())
    except (OSError, UnicodeDecodeError, ContractError) as error:
        raise StationError(f"{file}: {error}") from error


# Names do not change with their content, so a browser must ask each time if a file is still the same.
_CACHE = "no-cache"


def site_files(settings: Config, built: Path = BUILT) -> dict[str, bytes]:
    """Every file of the static page by its key. Raises `StationError` if the page is not built."""
    return built_files(built) | {"config.json": json.dumps(settings, allow_nan=False).encode()}


def upload(s3: S3Client, bucket: str, content: Mapping[str, bytes]) -> list[str]:
    """Make the bucket hold exactly ``content``; returns the other keys, which are deleted.

    The page itself comes last, after the files that it needs.
    """
    for key in sorted(content, key=lambda key: key == "index.html"):
        kind = TYPES[Path(key).suffix]
        s3.put_object(Bucket=bucket, Key=key, Body=content[key], ContentType=kind, CacheControl=_CACHE)
    deleted = []
    # A page has as many keys as one request may delete.
    for page in s3.get_paginator("list_objects_v2").paginate(Bucket=bucket):
        old = [entry["Key"] for entry in page.get("Contents", []) if entry["Key"] not in content]
        keys: list[ObjectIdentifierTypeDef] = [{"Key": key} for key in old]
        if keys:
            s3.delete_objects(Bucket=bucket, Delete={"Objects": keys, "Quiet": True})
        deleted += old
    return deleted


def publish(cloud: Cloud, settings: Config) -> str:
    """Upload the page, renew CloudFront's copies, and return the page's address.

    Raises `StationError` if the stack is not deployed.
    """
    content = site_files(settings)
    bucket, distribution = cloud.output("site", "PageBucket"), cloud.output("site", "PageDistribution")
    try:
        upload(cloud.client("s3"), bucket, content)
        cloud.client("cloudfront").create_invalidation(
            DistributionId=distribution,
            InvalidationBatch={
                "Paths": {"Quantity": 1, "Items": ["/*"]},
                "CallerReference": str(time.time_ns()),
            },
        )
    except ClientError as error:
        raise StationError(f"the page could not be uploaded: {error}") from error
    return cloud.output("site", "PageUrl")
