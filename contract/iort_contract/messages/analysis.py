"""A finding: what the analysis says of a drive, with its evidence. And the rows of the
table of findings: runs of the analysis, its drives, and people's notes.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Mapping, NamedTuple

from iort_contract.checks import checked, integer, shown, text
from iort_contract.limits import ContractError
from iort_contract.messages.envelope import each, read
from iort_contract.tables import T_US
from iort_contract.topics import check_robot, check_stream

# The share of repetitions in which an estimate's interval holds the truth.
INTERVAL = 0.9
# The run of a finding that is about no drive: a robot's drives could not be found.
NO_RUN = "00000000"


class Estimate(NamedTuple):
    """A value with its `INTERVAL`, in a unit."""

    value: float
    low: float
    high: float
    unit: str


@dataclass(frozen=True)
class DriveKey:
    """A drive: what a robot recorded from one stand to the next, in one run of its agent."""

    robot: str
    start_us: int
    run: str

    def __str__(self) -> str:
        """A text that sorts by time."""
        return f"{self.start_us:016d}-{self.run}"


@dataclass(frozen=True)
class Finding:
    """One finding about a drive.

    ``kind`` is an entry of the catalogue. ``subject`` is the parameter that changed, or the kind of an event.
    ``from_us`` to ``to_us`` is the evidence in the fields of a stream. ``effect`` is the size of the change
    or event, ``baseline`` what it is compared with. ``p`` is the chance of such an effect in a healthy car,
    and ``q`` the false discovery rate at which it still counts.
    """

    drive: DriveKey
    kind: str
    severity: str
    subject: str
    from_us: int
    to_us: int
    stream: str
    fields: tuple[str, ...]
    text: str
    effect: Estimate | None = None
    baseline: Estimate | None = None
    p: float | None = None
    q: float | None = None

    @property
    def id(self) -> str:
        """Unique within the robot, and the same whenever the drive is analysed again."""
        return f"{self.drive}-{self.kind}-{self.subject}-{self.from_us:016d}"


def encode_finding(finding: Finding) -> dict[str, Any]:
    """The finding as an object for JSON."""
    return {name: value for name, value in _flat(finding).items() if value is not None}


def _flat(message: Finding | PlannedDrive | AnalysedDrive) -> dict[str, Any]:
    """The message and its drive as one object."""
    content = {**vars(message.drive), **vars(message)}
    del content["drive"]
    return {name: _plain(value) for name, value in content.items()}


def _plain(value: Any) -> Any:
    if isinstance(value, Estimate):
        return encode_estimate(value)
    if isinstance(value, Mapping):
        return {name: _plain(content) for name, content in value.items()}
    return list(value) if isinstance(value, tuple) else value


def decode_finding(content: Mapping[str, Any]) -> Finding:
    """Decode a finding; raises `ContractError`."""
    return read(
        Finding,
        {**content, "drive": content},
        drive=partial(read, DriveKey),
        effect=decode_estimate,
        baseline=decode_estimate,
    )


def encode_estimate(estimate: Estimate) -> dict[str, Any]:
    """The estimate as an object for JSON."""
    return estimate._asdict()


decode_estimate = partial(read, Estimate)


@dataclass(frozen=True)
class AnalysisRequest:
    """The drives of ``robots`` that begin from ``start_us`` to ``end_us`` (exclusive).

    No robots means all. With ``again`` also those that have been analysed. Of each robot at most ``most``
    drives are analysed, and the rest waits; 0 is no limit.
    """

    robots: tuple[str, ...]
    start_us: int
    end_us: int
    again: bool = False
    most: int = 0


@dataclass(frozen=True)
class PlannedDrive:
    """A drive to analyse: its samples lie from its start to ``end_us``, inclusive.

    ``motion`` names the stream that tells where it stood; empty if none does.
    """

    drive: DriveKey
    end_us: int
    streams: tuple[str, ...]
    motion: str = ""


@dataclass(frozen=True)
class AnalysedDrive:
    """The row of an analysed drive: what later drives are compared with.

    ``job`` is the run of the analysis that made it, at ``analysed_us`` (0: a version that did not tell).
    ``missing`` gives reasons by the names of what could not be computed.
    """

    drive: DriveKey
    end_us: int
    job: str
    samples: int
    estimates: Mapping[str, Estimate]
    missing: Mapping[str, str]
    repairs: Mapping[str, int]
    analysed_us: int = 0


def encode_request(request: AnalysisRequest) -> dict[str, Any]:
    """The request as the state machine's input."""
    return {**vars(request), "robots": list(request.robots)}


def decode_request(content: Mapping[str, Any], now_us: int) -> AnalysisRequest:
    """Decode a request; raises `ContractError`.

    The schedule gives ``last_s`` instead of times, which counts back from now.
    """
    times = content
    if "last_s" in content:
        times = {"start_us": now_us - integer(content, "last_s") * 1_000_000, "end_us": now_us}
    request = read(AnalysisRequest, {"robots": [], **content, **times})
    if request.end_us <= request.start_us:
        seconds = (request.end_us - request.start_us) / 1e6
        raise ContractError(f"the range must be longer than 0, got {seconds:g} s")
    if request.most < 0:
        raise ContractError(f"most must be 0 or more, got {request.most}")
    return replace(request, robots=tuple(map(check_robot, request.robots)), start_us=max(0, request.start_us))


def encode_planned(planned: PlannedDrive) -> dict[str, Any]:
    """The drive as an object for JSON."""
    return _flat(planned)


def decode_planned(content: Mapping[str, Any]) -> PlannedDrive:
    """Decode a drive to analyse; raises `ContractError`."""
    planned = read(PlannedDrive, {**content, "drive": content}, drive=_drive)
    for stream in planned.streams:
        check_stream(stream)
    return planned


def encode_analysed(analysed: AnalysedDrive) -> dict[str, Any]:
    """The row's content as an object for JSON."""
    return _flat(analysed)


def decode_analysed(content: Mapping[str, Any]) -> AnalysedDrive:
    """Decode a row's content; raises `ContractError`."""
    return read(
        AnalysedDrive,
        {**content, "drive": content},
        drive=_drive,
        estimates=each(decode_estimate),
        missing=each(str),
        repairs=each(lambda count: integer({"repairs": count}, "repairs")),
    )


def _drive(content: Mapping[str, Any]) -> DriveKey:
    check_robot(text(content, "robot"))
    return read(DriveKey, content)


MAX_NOTE_CHARACTERS, MAX_AUTHOR_CHARACTERS = 500, 64
# The time that the note is about, in microseconds since the epoch, and digits that tell it from another one.
_NOTE = re.compile(r"[0-9]{16}-[0-9a-f]{8}")


@dataclass(frozen=True)
class Note:
    """``text`` is about ``robot`` at ``t_us``; ``by`` wrote it. ``salt``: 8 hex digits of chance."""

    robot: str
    t_us: int
    text: str
    by: str
    salt: str

    @property
    def id(self) -> str:
        """Unique within the robot; sorts by time."""
        return f"{self.t_us:016d}-{self.salt}"


def encode_note(note: Note) -> dict[str, Any]:
    """The note as an object for JSON; raises `ContractError` if it is invalid."""
    check_note(note)
    return dict(vars(note))


def decode_note(content: Mapping[str, Any]) -> Note:
    """Decode a note; raises `ContractError`."""
    note = read(Note, {**content, T_US: content.get("t_us")})
    check_note(note)
    return note


def check_note_id(note_id: str) -> str:
    """Return ``note_id`` if a note may have it."""
    return checked(_NOTE, note_id, "note", "the id of a note, 16 digits, a dash and 8 of 0-9 a-f")


def check_note(note: Note) -> None:
    """Raises `ContractError` for a note that cannot be written."""
    for name, value, least, most in (
        ("text", note.text, 1, MAX_NOTE_CHARACTERS),
        ("by", note.by, 0, MAX_AUTHOR_CHARACTERS),
    ):
        if not least <= len(value.strip()) or len(value) > most:
            raise ContractError(f"{name} must have {least} to {most} characters, got {len(value)}")
    if not 0 <= note.t_us < 10**16:
        raise ContractError(f"t_us must be microseconds since the epoch, got {shown(note.t_us)}")
    check_robot(note.robot)
    check_note_id(note.id)
