"""The named shadow of a robot: the settings that the operator desires, and what the agent reports.

The operator, the cloud and the robot write it, so a reader ignores what has another form."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Iterator, Mapping, NamedTuple, Sequence, TypeVar

from iort_contract.checks import check_field, shown
from iort_contract.limits import LIVE_MAX_RATE_HZ, LIVE_MIN_RATE_HZ, ContractError
from iort_contract.messages.commands import DriveLimits, decode_limits, encode_limits
from iort_contract.messages.envelope import read
from iort_contract.messages.recorder import (
    RECORDER,
    Wanted,
    decode_answers,
    decode_wanted,
    encode_answers,
)
from iort_contract.messages.video import VideoTerms, decode_terms, encode_terms
from iort_contract.tables import AGENT_VERSION, OVER_SHARE
from iort_contract.topics import COMMANDS, check_stream

M = TypeVar("M")

LOG_LEVELS = ("debug", "info", "warning", "error")
# When the live lane sends at its full rate.
WATCHED, ALWAYS = "watched", "always"
FIELDS = "fields"
MOTION_STOPPED = "motion.stopped"
FIELD_LIST = "a list of field names; an empty one means all fields"


@dataclass(frozen=True)
class Flag:
    """True or false."""

    @property
    def allowed(self) -> str:
        return "true or false"

    def accepts(self, value: Any) -> bool:
        return isinstance(value, bool)


@dataclass(frozen=True)
class Number:
    """A number from ``low`` to ``high``."""

    low: float
    high: float
    unit: str

    @property
    def allowed(self) -> str:
        return f"a number from {self.low:g} to {self.high:g} ({self.unit})"

    def accepts(self, value: Any) -> bool:
        return (
            not isinstance(value, bool) and isinstance(value, (int, float)) and self.low <= value <= self.high
        )


@dataclass(frozen=True)
class Choice:
    """One of some names."""

    names: Sequence[str]

    @property
    def allowed(self) -> str:
        return f"one of {', '.join(self.names)}"

    def accepts(self, value: Any) -> bool:
        return value in self.names


SETTINGS: Mapping[str, Flag | Number | Choice] = {
    "record.enabled": Flag(),
    "live.enabled": Flag(),
    "live.rate_hz": Number(LIVE_MIN_RATE_HZ, LIVE_MAX_RATE_HZ, "Hz"),
    "live.when": Choice((WATCHED, ALWAYS)),
    "ping.rate_hz": Number(0, 20, "Hz"),
    "log_level": Choice(LOG_LEVELS),
    # The emergency stop.
    MOTION_STOPPED: Flag(),
}
CHANGEABLE = (*SETTINGS, f"{FIELDS}.<stream>")


def check_name(name: str) -> None:
    """Raise `ContractError` for a setting that no agent knows."""
    if name.startswith(f"{FIELDS}."):
        check_stream(name[len(FIELDS) + 1 :])
    elif name not in SETTINGS:
        raise ContractError(f"{shown(name)} cannot be changed; must be one of {', '.join(CHANGEABLE)}")


def check_setting(name: str, value: Any) -> None:
    """Raise `ContractError` for a name or value that no agent accepts.

    An agent also refuses a selection of fields that its stream does not have.
    """
    check_name(name)
    if name not in SETTINGS:
        if not isinstance(value, list):
            raise ContractError(f"{name} must be {FIELD_LIST}, got {shown(value)}")
        for field in value:
            check_field(field)
    elif not SETTINGS[name].accepts(value):
        raise ContractError(f"{name} must be {SETTINGS[name].allowed}, got {shown(value)}")


REJECTED, DRIVE, MOVES, STOPS, VIDEO = "rejected", "drive", "moves", "stops", "video"
# Larger than any count, and than any time of a calendar.
_MOST = 10**15
_SECTIONS = (*dict.fromkeys(name.split(".")[0] for name in SETTINGS if "." in name), FIELDS)


@dataclass(frozen=True)
class OverShare:
    """The batches over a robot's share of the cloud, and the cloud's time of the first and the last one."""

    since_ms: int
    last_ms: int
    batches: int


class Rejection(NamedTuple):
    """A desired value that the agent rejects, and the reason for a human."""

    value: Any
    reason: str = ""


class Outcome(NamedTuple):
    """What became of a command: accepted, or the reason of its rejection."""

    session: str
    seq: int
    outcome: str


class Pressed(NamedTuple):
    """Who stopped a robot or released it, as they say, and when, by their clock."""

    by: str
    t_ms: int


class StopNotes(NamedTuple):
    """Who has stopped the ``robot`` alone, and who the ``fleet``; who has ``released`` the robot last."""

    robot: Pressed | None = None
    fleet: Pressed | None = None
    released: Pressed | None = None

    @property
    def newest(self) -> Pressed | None:
        """The newest of the stops."""
        return max(filter(None, (self.robot, self.fleet)), key=lambda pressed: pressed.t_ms, default=None)


@dataclass(frozen=True)
class Desired:
    """The desired settings by name, the cloud's notice, who asked for the emergency stop, and what the
    recorder is to keep. The settings and the recorder's part are not checked."""

    settings: Mapping[str, Any] = field(default_factory=dict)
    over_share: OverShare | None = None
    stops: StopNotes = field(default_factory=StopNotes)
    recorder: Wanted = field(default_factory=Wanted)

    @property
    def stopped_alone(self) -> bool:
        """Whether the release of the fleet leaves the robot stopped. A stop of an unknown source is its
        own."""
        return self.stops.robot is not None or self.stops.fleet is None


@dataclass(frozen=True)
class Reported:
    """The settings in force and the rejected ones, by name; the newest outcome of each command; what a stick
    drives, if the robot can be driven by hand. ``moves`` tells whether it has a motion that a stop ends; None
    of an agent that does not say so. ``recorder`` has the answer to each trigger: accepted, or why not.
    ``video`` is what the robot's camera can show; None without one."""

    settings: Mapping[str, Any] = field(default_factory=dict)
    rejected: Mapping[str, Rejection] = field(default_factory=dict)
    commands: Mapping[str, Outcome] = field(default_factory=dict)
    agent_version: str = ""
    drive: DriveLimits | None = None
    moves: bool | None = None
    recorder: Mapping[str, str] = field(default_factory=dict)
    video: VideoTerms | None = None


def decode_desired(document: Any) -> Desired:
    """The desired part of a shadow."""
    sections = dict(_mapping(document))
    notes = _mapping(sections.pop(STOPS, None))
    return Desired(
        over_share=_counted(OverShare, sections.pop(OVER_SHARE, None)),
        stops=StopNotes(*(_counted(Pressed, notes.get(name)) for name in StopNotes._fields)),
        recorder=decode_wanted(sections.pop(RECORDER, None)),
        settings=dict(_flat(sections)),
    )


def encode_stop(by: Pressed, *, fleet: bool) -> dict[str, Any]:
    """The change of the desired part that stops a robot, alone or with the fleet."""
    note = StopNotes(fleet=by) if fleet else StopNotes(robot=by)
    written = {name: pressed._asdict() for name, pressed in note._asdict().items() if pressed is not None}
    return {**nested({MOTION_STOPPED: True}), STOPS: written}


def encode_release(by: Pressed) -> dict[str, Any]:
    """The change of the desired part that releases a robot."""
    notes: dict[str, Any] = {**StopNotes()._asdict(), "released": by._asdict()}
    return {**nested({MOTION_STOPPED: False}), STOPS: notes}


def encode_fleet_released() -> dict[str, Any]:
    """The change for a robot that is stopped alone, too: it stays stopped."""
    return {STOPS: {"fleet": None}}


def decode_reported(document: Any) -> Reported:
    """The reported part of a shadow."""
    sections = dict(_mapping(document))
    rejected = _mapping(sections.pop(REJECTED, None))
    commands = _mapping(sections.pop(COMMANDS, None))
    version = sections.pop(AGENT_VERSION, "")
    drive = decode_limits(sections.pop(DRIVE, None))
    moves = sections.pop(MOVES, None)
    recorder = decode_answers(sections.pop(RECORDER, None))
    video = decode_terms(sections.pop(VIDEO, None))
    return Reported(
        dict(sorted(_flat(sections))),
        _each_valid(Rejection, dict(sorted(rejected.items()))),
        _each_valid(Outcome, commands),
        version if isinstance(version, str) else "",
        drive,
        moves if isinstance(moves, bool) else None,
        recorder,
        video,
    )


def encode_reported(reported: Reported) -> dict[str, Any]:
    """The reported part as an object for JSON."""
    return {
        **{section: {} for section in _SECTIONS},
        **nested(reported.settings),
        REJECTED: {name: rejection._asdict() for name, rejection in reported.rejected.items()},
        COMMANDS: {name: outcome._asdict() for name, outcome in reported.commands.items()},
        AGENT_VERSION: reported.agent_version,
        DRIVE: encode_limits(reported.drive),
        MOVES: reported.moves,
        RECORDER: encode_answers(reported.recorder),
        VIDEO: encode_terms(reported.video),
    }


def nested(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Settings by name as the sections of a document."""
    document: dict[str, Any] = {}
    for name, value in settings.items():
        section, _, rest = name.partition(".")
        if rest:
            document.setdefault(section, {})[rest] = value
        else:
            document[section] = value
    return document


def _valid(kind: type[M], content: Any) -> M | None:
    """The message in an entry; None if it has another form."""
    try:
        return read(kind, content)
    except ContractError:
        return None


def _counted(kind: type[M], content: Any) -> M | None:
    """The message in an entry; None too if one of its counts or times is none."""
    counts = [value for value in _mapping(content).values() if type(value) is int]
    return _valid(kind, content) if all(0 <= count < _MOST for count in counts) else None


def _each_valid(kind: type[M], contents: Mapping[str, Any]) -> dict[str, M]:
    valid = {name: _valid(kind, content) for name, content in contents.items()}
    return {name: message for name, message in valid.items() if message is not None}


def _flat(document: Mapping[str, Any]) -> Iterator[tuple[str, Any]]:
    for name, value in document.items():
        if isinstance(value, dict):
            for inner, item in value.items():
                yield f"{name}.{inner}", item
        else:
            yield name, value


def _mapping(value: Any) -> Mapping[str, Any]:
    return value if isinstance(value, dict) else {}
