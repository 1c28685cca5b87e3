"""What an operator tells a robot: settings, by its named shadow `agent`, and commands; and asks in its name.

Settings have the names and units of car.yaml. The robot reports in the shadow what is in force, what it
rejects, and the outcome of a command that asks for an answer.
"""

from __future__ import annotations

import getpass
import json
import secrets
import time
from collections.abc import Callable, Generator, Iterator, Mapping
from contextlib import contextmanager, suppress
from email.utils import parsedate_to_datetime
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

from iort_contract.limits import ContractError
from iort_contract.messages import commands
from iort_contract.messages.shadow import (
    FIELDS,
    MOTION_STOPPED,
    SETTINGS,
    STOPS,
    Choice,
    Desired,
    OverShare,
    Rejection,
    Reported,
    check_name,
    check_setting,
    decode_desired,
    decode_reported,
    nested,
)
from iort_contract.messages.video import VideoTerms
from iort_contract.tables import DISCONNECTED_MS, ONLINE
from iort_contract.topics import CMD, SHADOW, build_topic
from iort_station.cloud import Cloud, invoke
from iort_station.errors import StationError, UsageError
from iort_station.fleet import registry
from iort_station.times import iso_s

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
            name: rejection
            for name, rejection in self.reported.rejected.items()
            if name in desired and _same(rejection.value, desired[name])
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

    def desire(self, wanted: Mapping[str, Any], version: int = 0) -> None:
        """Set desired settings by dotted name; None returns to the file's value. An emergency stop that is
        asked for so is nobody's, and the robot's own. AWS refuses another ``version`` than the shadow's,
        unless it is 0."""
        notes = {STOPS: None} if MOTION_STOPPED in wanted else {}
        document = {
            "state": {"desired": {**nested(wanted), **notes}},
            **({"version": version} if version else {}),
        }
        self.data.update_thing_shadow(thingName=self.robot, shadowName=SHADOW, payload=json.dumps(document))

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


def settled(wanted: Mapping[str, Any], state: State) -> bool | None:
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
    report = state.reported.commands.get(name)
    return report.outcome if report is not None and report[:2] == (session, seq) else None


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


# How long a robot may take to return to the file's value.
_WITHDRAWN_S = 3.0
# A robot that the registry does not yet know to be connected may still answer.
_OFFLINE_S = 2.0


class Changed(NamedTuple):
    """The shadow after a change, what the robot rejected of it, and whether it answered in time."""

    state: State
    rejected: Mapping[str, Rejection]
    online: bool
    answered: bool


def parse_setting(name: str, text: str) -> Any:
    """The value of a setting that somebody has typed; raises `UsageError` for one that no agent accepts."""
    value: Any = text
    if name.startswith(f"{FIELDS}."):
        value = [field.strip() for field in text.split(",") if field.strip()]
    elif not isinstance(SETTINGS.get(name), Choice):
        with suppress(ValueError):  # refused below
            value = json.loads(text)
    with _nothing_changed():
        check_setting(name, value)
    return value


@contextmanager
def _nothing_changed() -> Iterator[None]:
    try:
        yield
    except ContractError as error:
        raise UsageError(f"{error}; nothing is changed") from error


def setting_text(value: Any) -> str:
    """A setting's value as somebody types it."""
    if isinstance(value, float) and value.is_integer():
        value = int(value)
    return ",".join(map(str, value)) if isinstance(value, list) else json.dumps(value).strip('"')


def change_settings(cloud: Cloud, robot: str, wanted: Mapping[str, Any], seconds: float) -> Changed:
    """Desire settings by dotted name, and wait for the robot; None returns to the file's value.

    A change that the robot rejects is withdrawn: the last accepted value stays in force. The values must have
    passed `check_setting`. Raises `StationError` for an unknown robot, and `UsageError` for an unknown
    setting that is not desired either.
    """
    shadow = Shadow(cloud, robot)
    online = bool(registry.get(cloud, robot).get(ONLINE))
    before = shadow.read()
    with _nothing_changed():
        for name in wanted.keys() - before.desired.settings.keys():
            check_name(name)
    in_time = _change_and_wait(shadow, before, wanted, seconds if online else min(seconds, _OFFLINE_S))
    state = shadow.read()
    rejected = {name: rejection for name, rejection in state.rejected().items() if name in wanted}
    _withdraw(shadow, before, state, {name: wanted[name] for name in rejected})
    return Changed(state, rejected, online, in_time)


def _change_and_wait(shadow: Shadow, before: State, wanted: Mapping[str, Any], seconds: float) -> bool:
    """Request the changes; whether the robot has answered in time."""
    shadow.desire(wanted)
    if shadow.wait(lambda state: settled(wanted, state), seconds) is None:
        return False
    old, requested = before.reported.settings, before.desired.settings
    withdrawn = [n for n, value in wanted.items() if value is None and requested.get(n) == old.get(n)]
    if withdrawn:
        # The file may hold the same value, which the robot does not report again.
        shadow.wait(
            lambda state: all(state.reported.settings.get(n) != old.get(n) for n in withdrawn) or None,
            min(seconds, _WITHDRAWN_S),
        )
    return True


def _withdraw(shadow: Shadow, before: State, state: State, rejected: Mapping[str, Any]) -> None:
    """Replace rejected changes by the desired values before them, unless somebody has changed them since."""
    old, now = before.desired.settings, state.desired.settings
    known = before.rejected()
    again = {
        name: None if name in known else old.get(name)
        for name, value in rejected.items()
        if now.get(name) == value
    }
    if again:
        shadow.desire(again)


VALID_MS, ANSWER_S = 2_000, 10.0


# A robot of which the registry does not yet know that it is connected may still answer.
_ADVICE = {
    commands.NO_LEASE: "say by --lease-ms how long it may move, such as --lease-ms 500",
    commands.DRIVEN_BY_ANOTHER: "wait for the end of the other lease, or take the wheel by --takeover",
    commands.NO_PICTURE: "drive it on the page, by its picture; --blind moves it without",
}


class Sent(NamedTuple):
    """A command that was sent. ``outcome`` is `ACCEPTED`, the robot's reason, or None without an answer;
    ``offline`` says that the registry does not know it to be connected, or is empty."""

    command: commands.Command
    outcome: str | None
    offline: str = ""


def advice(outcome: str) -> str:
    """What helps against a rejection; empty if nothing in particular does."""
    for reason, text in _ADVICE.items():
        if outcome.startswith(reason.replace("_", " ")):
            return text
    return ""


def operator() -> str:
    """Who sends commands from this computer: the user's name, as the computer knows it."""
    try:
        name = getpass.getuser()
    except (OSError, KeyError):  # no such user, as in a container
        name = "unknown"
    return "".join(filter(str.isprintable, name))[: commands.MAX_BY_CHARACTERS] or "unknown"


def send(cloud: Cloud, robot: str, name: str, message: Mapping[str, Any], **given: Any) -> Sent:
    """As `sending`, which has the arguments, in one call."""
    return slept(sending(cloud, robot, name, message, **given))


def sending(
    cloud: Cloud,
    robot: str,
    name: str,
    message: Mapping[str, Any],
    *,
    lease_ms: int | None = None,
    valid_ms: int = VALID_MS,
    seconds: float = ANSWER_S,
    takeover: bool = False,
    blind: bool = False,
    on_offline: Callable[[str], None] = lambda _text: None,
) -> Generator[None, None, Sent]:
    """Send a command and wait for the robot's answer, at most ``seconds``: it yields between two looks.

    Every call is an operator's session of its own. While another one drives, its motion is refused, unless it
    says ``takeover``. ``lease_ms`` is how long the robot may move; one with video only if it is said to move
    ``blind``. A robot that is not connected is hardly waited for; ``on_offline`` learns it at once. Raises
    `UsageError` for an unknown robot and for an invalid command, before it is sent.
    """
    shadow = Shadow(cloud, robot)
    if lease_ms is not None and not blind:
        check_blind(robot, shadow.read().reported.video)
    now_us = time.time_ns() // 1000
    try:
        topic = build_topic(CMD, robot, name, cloud.namespace)
        command = commands.Command(
            session=secrets.token_hex(8),
            started_us=now_us,
            seq=0,
            sent_us=now_us,
            valid_ms=valid_ms,
            message=message,
            lease_ms=lease_ms,
            answer=True,
            by=operator(),
            takeover=takeover,
            blind=blind,
        )
        payload = commands.encode_command(command)
    except ContractError as error:
        raise UsageError(str(error)) from error
    shadow.data.publish(topic=topic, qos=1, payload=payload)
    if offline := _offline(cloud, robot):
        on_offline(offline)
        seconds = min(seconds, _OFFLINE_S)
    answer = yield from shadow.waiting(
        lambda state: outcome(state, name, command.session, command.seq), seconds
    )
    return Sent(command, answer, offline if answer is None else "")


def check_blind(robot: str, video: VideoTerms | None) -> None:
    """Raise `UsageError` if a robot is to be moved from here that takes no motion without its picture."""
    if video is not None:
        raise UsageError(
            f"{robot} has a camera, and takes no motion without its picture; nothing is sent. Drive it on "
            "the page, or move it blind (--blind), which is recorded"
        )


def _offline(cloud: Cloud, robot: str) -> str:
    row = registry.get(cloud, robot)
    if row.get(ONLINE):
        return ""
    since_ms = row.get(DISCONNECTED_MS)
    return f"{robot} is not connected" + (f" since {iso_s(int(since_ms) * 1000)}" if since_ms else "")


def ask(cloud: Cloud, robot: str, question: str, body: Mapping[str, Any]) -> dict[str, Any]:
    """The answer's body to a question that is asked in the robot's name, without quota or deadline.

    Raises `StationError` if the function refuses or fails.
    """
    event = json.dumps({"robot": robot, "question": question, "body": body}).encode()
    answer = json.loads(invoke(cloud, "processing", "AnswerFunction", event, "the function answer"))
    if "refused" in answer:
        raise StationError(f"{answer['refused']}: {answer['text']}")
    return dict(answer["body"])
