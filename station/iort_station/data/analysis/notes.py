"""Notes that people write about robots: beside the findings, by robot and time."""

from __future__ import annotations

import secrets
import time

from iort_contract.limits import ContractError
from iort_contract.messages.analysis.notes import Note, check_note_id
from iort_station.cloud import Cloud
from iort_station.data.analysis.findings import named, table
from iort_station.errors import StationError, UsageError
from iort_station.fleet import registry


def notes(
    cloud: Cloud,
    robot: str | None = None,
    start_us: int | None = None,
    end_us: int | None = None,
    *,
    most: int | None = None,
) -> list[Note]:
    """Notes about a range, the newest first; of all robots without one."""
    found = [
        note for name in named(cloud, robot) for note in table(cloud).notes(name, start_us, end_us, most=most)
    ]
    return sorted(found, key=lambda note: note.id, reverse=True)[:most]


def write(cloud: Cloud, robot: str, text: str, *, by: str, t_us: int | None = None) -> Note:
    """Write a note about a registered robot at a time; the default is now.

    Raises `UsageError` for a text that is empty or too long.
    """
    registry.get(cloud, robot)
    at_us = time.time_ns() // 1000 if t_us is None else t_us
    note = Note(robot, at_us, text.strip(), by, secrets.token_hex(4))
    try:
        table(cloud).put_note(note)
    except ContractError as error:
        raise UsageError(f"{error}; nothing is written") from error
    return note


def remove(cloud: Cloud, robot: str, note_id: str) -> None:
    """Delete a note; raises `StationError` if the robot has none of this id."""
    registry.checked(robot)
    try:
        check_note_id(note_id)
    except ContractError as error:
        raise UsageError(str(error)) from error
    if not table(cloud).remove_note(robot, note_id):
        raise StationError(f"{robot} has no note {note_id}; `iort note {robot}` lists them")
