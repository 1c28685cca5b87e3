"""A robot's named shadow `agent` from the operator's side: desired settings, and the robot's reports.

Settings have the names and units of car.yaml.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Generator, Mapping
from email.utils import parsedate_to_datetime
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

from iort_contract.messages.control.settings import MOTION_STOPPED
from iort_contract.messages.control.shadow import (
    STOPS,
    Desired,
    OverShare,
    Rejection,
    Reported,
    decode_desired,
    decode_reported,
    nested,
)
from iort_contract.topics import SHADOW
from iort_station.cloud import Cloud
from iort_station.errors import StationError
from iort_station.fleet import registry

if TYPE_CHECKING:
    from types_boto3_iot_data import IoTDataPlaneClient

_POLL_S = 0.3
# HTTP's Date has whole seconds, so smaller differences may be rounding.
_CLOCK_S = 2.0
_Found = TypeVar("_Found")


class State(NamedTuple):
    """The shadow's desired and reported parts, and its version; empty if the robot has none yet."""

    desired: Desired = Desired()
    reported: Reported = Reported()
    version: int = 0

    def rejected(self) -> Mapping[str, Rejection]:
        """What the robot rejects of the desired settings; not its rejection of an earlier value."""
        desired = self.desired.settings
        return {
            name: one
            for name, one in self.reported.rejected.items()
            if name in desired and _same(one.value, desired[name])
        }

    @property
    def stop_rejected(self) -> bool:
        """Whether the robot has rejected the stop that is asked for, which holds nothing then."""
        return self.desired.settings.get(MOTION_STOPPED) is True and MOTION_STOPPED in self.rejected()

    def pending(self) -> dict[str, Any]:
        """The desired settings, by name, that the robot has neither applied nor rejected."""
        in_force, rejected = self.reported.settings, self.rejected()
        return {
            name: value
            for name, value in self.desired.settings.items()
            # An empty list of fields means all, which is not reported.
            if name not in rejected and in_force.get(name, []) != value
        }


class Shadow:
    """The shadow of a registered robot. Raises `StationError` for any other, and if this computer's clock is
    wrong, since robots judge commands by their time."""

    def __init__(self, cloud: Cloud, robot: str) -> None:
        self.robot = registry.checked(robot)
        iot = cloud.client("iot")
        began_s = time.time()
        try:
            answer = iot.describe_thing(thingName=robot)
        except iot.exceptions.ResourceNotFoundException as error:
            raise registry.not_registered(cloud, robot) from error
        _check_clock(answer["ResponseMetadata"]["HTTPHeaders"].get("date"), began_s, time.time())
        self.data = cloud.client("iot-data")

    def read(self) -> State:
        return read(self.data, self.robot)

    def desire(self, wanted: Mapping[str, Any]) -> None:
        """Set desired settings by dotted name; None returns to the file's value. An emergency stop that is
        asked for so is nobody's, and the robot's own."""
        notes = {STOPS: None} if MOTION_STOPPED in wanted else {}
        payload = json.dumps({"state": {"desired": {**nested(wanted), **notes}}})
        self.data.update_thing_shadow(thingName=self.robot, shadowName=SHADOW, payload=payload)

    def wait(self, found: Callable[[State], _Found | None], seconds: float) -> _Found | None:
        """Wait until ``found`` returns a value for the state; None after ``seconds``."""
        return slept(self.waiting(found, seconds))

    def waiting(
        self, found: Callable[[State], _Found | None], seconds: float
    ) -> Generator[None, None, _Found | None]:
        """As `wait`; it yields where that sleeps."""
        deadline = time.monotonic() + seconds
        while (value := found(self.read())) is None and time.monotonic() < deadline:
            yield
        return value


def slept(waiting: Generator[None, None, _Found]) -> _Found:
    """The result of what waits for a robot."""
    while True:
        try:
            next(waiting)
        except StopIteration as end:
            result: _Found = end.value
            return result
        # A shadow sends no events to this API.
        time.sleep(_POLL_S)


def over_share(cloud: Cloud, robot: str) -> OverShare | None:
    """Lambda 2's last report on a robot over its share; None if it has none."""
    return read(cloud.client("iot-data"), robot).desired.over_share


def read(data: IoTDataPlaneClient, robot: str) -> State:
    """The shadow's current state."""
    try:
        answer = data.get_thing_shadow(thingName=robot, shadowName=SHADOW)
    except data.exceptions.ResourceNotFoundException:
        return State()
    document = json.loads(answer["payload"].read())
    state = document.get("state", {})
    desired, reported = decode_desired(state.get("desired")), decode_reported(state.get("reported"))
    return State(desired, reported, document.get("version", 0))


def answered(wanted: Mapping[str, Any], state: State) -> bool | None:
    """True once each desired setting is in use or rejected, otherwise None. A withdrawn setting is answered
    once it is no longer rejected."""
    settings, rejected = state.reported.settings, state.reported.rejected
    for name, value in wanted.items():
        if name in rejected:
            if value is None or not _same(rejected[name].value, value):
                return None
        # An empty list of fields means all, which is not reported.
        elif value is not None and settings.get(name, []) != value:
            return None
    return True


def outcome(state: State, name: str, session: str, seq: int) -> str | None:
    """The robot's report on a command; None until it reports."""
    found = state.reported.commands.get(name)
    return found.outcome if found is not None and found[:2] == (session, seq) else None


def _same(quoted: Any, value: Any) -> bool:
    # The robot cuts long values in its report.
    cut = isinstance(quoted, str) and quoted.endswith("...") and quoted != value
    return json.dumps(value).startswith(quoted[:-3]) if cut else bool(quoted == value)


def _check_clock(date: str | None, began_s: float, ended_s: float) -> None:
    if date is None:
        return
    cloud_s = parsedate_to_datetime(date).timestamp()
    off_s = max(began_s - (cloud_s + 1), cloud_s - ended_s)
    if off_s > _CLOCK_S:
        raise StationError(
            f"this computer's clock differs by {off_s:.0f} s from the cloud's: set it (NTP), then try again"
        )
