"""The live page's files and its configuration.

``npm run build`` makes it from station/web into the folder `built`. `iort_station.page.server` serves it, and
`iort_station.page.site` publishes it on the web.
"""

from __future__ import annotations

import math
import re
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from iort_contract.cloud import PUBNUB
from iort_contract.limits import ContractError
from iort_contract.messages.page import Config, Identity, TrackMap
from iort_contract.page import PUBNUB_ORIGIN
from iort_contract.topics import check_namespace, check_robot
from iort_contract.track import Track, parse_track
from iort_station.errors import StationError

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

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
        gain = car.get("speed_to_erpm_gain")
        if gain is not None and (not math.isfinite(gain) or gain == 0):
            raise StationError(f"speed_to_erpm_gain of {robot} must be a number other than 0, got {gain}")
        offset = car.get("speed_to_erpm_offset", 0)
        if not math.isfinite(offset):
            raise StationError(f"speed_to_erpm_offset of {robot} must be a number, got {offset}")
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
        "track": None if track is None else _track_map(track),
    }


def load_track(file: Path) -> Track:
    """The track of a CSV file; raises `StationError` for another file."""
    try:
        return parse_track(file.read_text())
    except (OSError, UnicodeDecodeError, ContractError) as error:
        raise StationError(f"{file}: {error}") from error


def _track_map(track: Track) -> TrackMap:
    return {
        "x_m": list(track.x_m),
        "y_m": list(track.y_m),
        "w_right_m": list(track.w_right_m),
        "w_left_m": list(track.w_left_m),
    }
