"""A robot's named shadow `agent` from the operator's side: desired settings, and the robot's reports.

Settings have the names and units of car.yaml.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator, Mapping
from email.utils import parsedate_to_datetime
from typing import Any, NamedTuple, TypeVar

from iort_contract.limits import ContractError
from iort_contract.tables import AGENT_VERSION, OVER_SHARE, PUT_OFF, PUT_OFF_LAST_MS, PUT_OFF_SINCE_MS
from iort_contract.topics import COMMANDS, SHADOW, check_robot
from iort_station.cloud import Cloud
from iort_station.errors import StationError
from iort_station.fleet import registry

_POLL_S = 0.3
# HTTP's Date has whole seconds, so smaller differences may be rounding.
_CLOCK_S = 2.0
# Every valid count and time is smaller.
_MOST = 10**14
_Found = TypeVar("_Found")


class Rejection(NamedTuple):
    """A desired setting that the robot rejected, and the reason."""

    name: str
    value: Any
    reason: str


class State(NamedTuple):
    """The shadow's version and content; empty if the robot has none yet."""

    version: int
    desired: Mapping[str, Any]
    reported: Mapping[str, Any]

    def settings(self) -> dict[str, Any]:
        """The settings in use, by dotted name, as the robot last reported them."""
        own = {k: v for k, v in self.reported.items() if k not in {"rejected", COMMANDS, AGENT_VERSION}}
        return dict(sorted(_flat(own)))

    def desired_settings(self) -> dict[str, Any]:
        """The desired settings, by dotted name."""
        return dict(_flat({name: value for name, value in self.desired.items() if name != OVER_SHARE}))

    def rejections(self) -> list[Rejection]:
        """The desired settings that the robot rejects; entries of another form are ignored."""
        found = _mapping(self.reported.get("rejected"))
        return [
            Rejection(name, one.get("value"), str(one.get("reason", "")))
            for name, one in sorted(found.items())
            if isinstance(one, dict)
        ]


class Shadow:
    """The shadow of a registered robot. Raises `StationError` for any other, and if this computer's clock is
    wrong, since robots judge commands by their time."""

    def __init__(self, cloud: Cloud, robot: str) -> None:
        try:
            self.robot = check_robot(robot)
        except ContractError as error:
            raise StationError(str(error)) from error
        iot = cloud.client("iot")
        began_s = time.time()
        try:
            answer = iot.describe_thing(thingName=robot)
        except iot.exceptions.ResourceNotFoundException as error:
            raise registry.not_registered(cloud, robot) from error
        _check_clock(answer["ResponseMetadata"]["HTTPHeaders"].get("date"), began_s, time.time())
        self.data = cloud.client("iot-data")

    def read(self) -> State:
        """The shadow's current state."""
        return _read(self.data, self.robot)

    def desire(self, wanted: Mapping[str, Any]) -> None:
        """Set desired settings by dotted name; None returns to the file's value."""
        desired: dict[str, Any] = {}
        for name, value in wanted.items():
            first, _, rest = name.partition(".")
            if rest:
                desired.setdefault(first, {})[rest] = value
            else:
                desired[first] = value
        payload = json.dumps({"state": {"desired": desired}})
        self.data.update_thing_shadow(thingName=self.robot, shadowName=SHADOW, payload=payload)

    def wait(self, found: Callable[[State], _Found | None], seconds: float) -> _Found | None:
        """Wait until ``found`` returns a value for the state; None after ``seconds``."""
        deadline = time.monotonic() + seconds
        while (value := found(self.read())) is None and time.monotonic() < deadline:
            # A shadow sends no events to this API.
            time.sleep(_POLL_S)
        return value


class OverShare(NamedTuple):
    """The batches that the cloud put off: their number, and the first and last time."""

    batches: int
    since_ms: int
    last_ms: int


def over_share(cloud: Cloud, robot: str) -> OverShare | None:
    """Lambda 2's last report on a robot over its share; None if it has none."""
    said = _read(cloud.client("iot-data"), robot).desired.get(OVER_SHARE)
    names = (PUT_OFF, PUT_OFF_SINCE_MS, PUT_OFF_LAST_MS)
    # The robot can write this too, so it may be anything.
    if not isinstance(said, dict) or not all(
        type(said.get(name)) is int and 0 <= said[name] < _MOST for name in names
    ):
        return None
    return OverShare(*(said[name] for name in names))


def _read(data: Any, robot: str) -> State:
    try:
        answer = data.get_thing_shadow(thingName=robot, shadowName=SHADOW)
    except data.exceptions.ResourceNotFoundException:
        return State(0, {}, {})
    document = json.loads(answer["payload"].read())
    state = document.get("state", {})
    return State(document.get("version", 0), state.get("desired") or {}, state.get("reported") or {})


def answered(wanted: Mapping[str, Any], state: State) -> bool | None:
    """True once each desired setting is in use or rejected, otherwise None. A withdrawn setting is answered
    once it is no longer rejected."""
    settings, rejected = state.settings(), {one.name: one for one in state.rejections()}
    for name, value in wanted.items():
        if name in rejected:
            if value is None or not _same(rejected[name].value, value):
                return None
        elif value is not None and value != [] and settings.get(name) != value:
            return None
    return True


def outcome(state: State, name: str, session: str, seq: int) -> str | None:
    """The robot's report on a command; None until it reports."""
    found = _mapping(_mapping(state.reported.get(COMMANDS)).get(name))
    if (found.get("session"), found.get("seq")) != (session, seq):
        return None
    return str(found.get("outcome"))


def _mapping(value: Any) -> Mapping[str, Any]:
    """A reported object; an empty one for any other value."""
    return value if isinstance(value, dict) else {}


def _same(quoted: Any, value: Any) -> bool:
    # The robot cuts long values in its report.
    cut = isinstance(quoted, str) and quoted.endswith("...") and quoted != value
    return json.dumps(value).startswith(quoted[:-3]) if cut else bool(quoted == value)


def _flat(values: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    for name, value in values.items():
        if isinstance(value, dict):
            yield from _flat(value, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}", value


def _check_clock(date: str | None, began_s: float, ended_s: float) -> None:
    if date is None:
        return
    cloud_s = parsedate_to_datetime(date).timestamp()
    off_s = max(began_s - (cloud_s + 1), cloud_s - ended_s)
    if off_s > _CLOCK_S:
        raise StationError(
            f"this computer's clock differs by {off_s:.0f} s from the cloud's: set it (NTP), then try again"
        )
