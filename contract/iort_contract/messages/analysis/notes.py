"""A note: what a person wrote about a robot at a time."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Any, Mapping

from iort_contract.checks import checked, integer, shown, text
from iort_contract.limits import ContractError
from iort_contract.topics import check_robot

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
    _check(note)
    return dict(vars(note))


def decode_note(content: Mapping[str, Any]) -> Note:
    """Decode a note; raises `ContractError`."""
    note = Note(
        check_robot(text(content, "robot")),
        integer(content, "t_us"),
        text(content, "text"),
        text(content, "by"),
        text(content, "salt"),
    )
    _check(note)
    return note


def check_note_id(note_id: str) -> str:
    """Return ``note_id`` if a note may have it."""
    return checked(_NOTE, note_id, "note", "the id of a note, 16 digits, a dash and 8 of 0-9 a-f")


def _check(note: Note) -> None:
    for name, value, least, most in (
        ("text", note.text, 1, MAX_NOTE_CHARACTERS),
        ("by", note.by, 0, MAX_AUTHOR_CHARACTERS),
    ):
        if not least <= len(value.strip()) or len(value) > most:
            raise ContractError(f"{name} must have {least} to {most} characters, got {len(value)}")
    if not 0 <= note.t_us < 10**16:
        raise ContractError(f"t_us must be microseconds since the epoch, got {shown(note.t_us)}")
    check_note_id(note.id)
