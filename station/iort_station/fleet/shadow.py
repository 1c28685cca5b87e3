"""A robot's named shadow `agent` from the operator's side: what is in force, wishes, and answers.

Units are those of the settings' names, which are car.yaml's.
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

_POLL_S = 0.3
# HTTP's Date is a whole second: a clock more than this off it is off.
_CLOCK_S = 2.0
# No count and no time that a calendar has is as large.
_MOST = 10**14
_Found = TypeVar("_Found")


class Refusal(NamedTuple):
    """A wish that the robot refused, and why."""

    name: str
    value: Any
    reason: str


class State(NamedTuple):
    """The shadow's version, and what stands in it; empty where the robot has none yet."""

    version: int
    desired: Mapping[str, Any]
    reported: Mapping[str, Any]

    def settings(self) -> dict[str, Any]:
        """What is in force: dotted name to value, as the robot reported it last."""
        own = {k: v for k, v in self.reported.items() if k not in {"rejected", COMMANDS, AGENT_VERSION}}
        return dict(sorted(_flat(own)))

    def wished(self) -> dict[str, Any]:
        """What is desired: dotted name to value."""
        return dict(_flat({name: value for name, value in self.desired.items() if name != OVER_SHARE}))

    def refusals(self) -> list[Refusal]:
        """The wishes that the robot refuses; none where it says so in another form."""
        found = _mapping(self.reported.get("rejected"))
        return [
            Refusal(name, one.get("value"), str(one.get("reason", "")))
            for name, one in sorted(found.items())
            if isinstance(one, dict)
        ]


class Shadow:
    """The shadow of a registered robot. Raises `StationError` for any other, and where this computer's
    clock is so far off the cloud's that nothing it sends could be judged by its time."""

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
            raise StationError(f"robot {robot} is not registered: `iort robots list`") from error
        _check_clock(answer["ResponseMetadata"]["HTTPHeaders"].get("date"), began_s, time.time())
        self.data = cloud.client("iot-data")

    def read(self) -> State:
        """What stands in the shadow now."""
        try:
            answer = self.data.get_thing_shadow(thingName=self.robot, shadowName=SHADOW)
        except self.data.exceptions.ResourceNotFoundException:
            return State(0, {}, {})
        document = json.loads(answer["payload"].read())
        state = document.get("state", {})
        return State(document.get("version", 0), state.get("desired") or {}, state.get("reported") or {})

    def wish(self, wishes: Mapping[str, Any]) -> None:
        """Desire settings by dotted name; None withdraws a wish, and the file's value counts again."""
        desired: dict[str, Any] = {}
        for name, value in wishes.items():
            first, _, rest = name.partition(".")
            if rest:
                desired.setdefault(first, {})[rest] = value
            else:
                desired[first] = value
        payload = json.dumps({"state": {"desired": desired}})
        self.data.update_thing_shadow(thingName=self.robot, shadowName=SHADOW, payload=payload)

    def wait(self, found: Callable[[State], _Found | None], seconds: float) -> _Found | None:
        """What ``found`` says of the shadow as soon as it says something; None after ``seconds``."""
        deadline = time.monotonic() + seconds
        while (value := found(self.read())) is None and time.monotonic() < deadline:
            # A shadow tells its reader nothing by itself.
            time.sleep(_POLL_S)
        return value


class OverShare(NamedTuple):
    """What the cloud said of batches that it put off: how many, since when and when last."""

    batches: int
    since_ms: int
    last_ms: int


def over_share(cloud: Cloud, robot: str) -> OverShare | None:
    """What Lambda 2 said last of a robot that was over its share; None where it said nothing."""
    data = cloud.client("iot-data")
    try:
        answer = data.get_thing_shadow(thingName=robot, shadowName=SHADOW)
    except data.exceptions.ResourceNotFoundException:
        return None
    desired = json.loads(answer["payload"].read()).get("state", {}).get("desired") or {}
    said = desired.get(OVER_SHARE)
    names = (PUT_OFF, PUT_OFF_SINCE_MS, PUT_OFF_LAST_MS)
    # The robot may write there as well.
    if not isinstance(said, dict) or not all(
        type(said.get(name)) is int and 0 <= said[name] < _MOST for name in names
    ):
        return None
    return OverShare(*(said[name] for name in names))


def answered(wishes: Mapping[str, Any], state: State) -> bool | None:
    """Whether the robot has answered all the wishes, which is True or None (not yet): each is in force
    or refused. A wish withdrawn is answered when it is refused no longer."""
    settings, refused = state.settings(), {refusal.name: refusal for refusal in state.refusals()}
    for name, value in wishes.items():
        if name in refused:
            if value is None or not _same(refused[name].value, value):
                return None
        elif value is not None and value != [] and settings.get(name) != value:
            return None
    return True


def outcome(state: State, name: str, session: str, seq: int) -> str | None:
    """What the robot says became of a command; None while it has said nothing of this one."""
    found = _mapping(_mapping(state.reported.get(COMMANDS)).get(name))
    if (found.get("session"), found.get("seq")) != (session, seq):
        return None
    return str(found.get("outcome"))


def _mapping(value: Any) -> Mapping[str, Any]:
    """What a robot reports where an object is expected; an empty one for anything else."""
    return value if isinstance(value, dict) else {}


def _same(quoted: Any, value: Any) -> bool:
    # The robot quotes what is long by its beginning.
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
            f"this computer's clock is {off_s:.0f} s off the cloud's: set it (NTP), then try again"
        )
