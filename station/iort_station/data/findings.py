"""What is known of drives: findings, analysed drives, people's notes, and a car's calibration."""

from __future__ import annotations

import re
import secrets
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import chain, islice
from typing import NamedTuple, TypeVar

from iort_contract.catalog.car import GROUPS
from iort_contract.catalog.derived import Vehicle
from iort_contract.findings_table import FindingsTable
from iort_contract.limits import ContractError
from iort_contract.messages.analysis import AnalysedDrive, Estimate, Finding, Note, check_note, check_note_id
from iort_station.cloud import Cloud
from iort_station.errors import StationError, UsageError
from iort_station.fleet import recorder, registry

_T = TypeVar("_T", Finding, AnalysedDrive, Note)


def findings_table(cloud: Cloud) -> FindingsTable:
    """The table of findings."""
    return FindingsTable(cloud.client("dynamodb"), cloud.output("storage", "FindingsTable"))


def robots_of(cloud: Cloud, robot: str | None) -> list[str]:
    """The robot, or every robot without one."""
    return sorted(row["robot"] for row in registry.listed(cloud)) if robot is None else [robot]


def findings(
    cloud: Cloud,
    robot: str | None = None,
    start_us: int | None = None,
    end_us: int | None = None,
    *,
    most: int | None = None,
) -> list[Finding]:
    """Findings about drives that begin in a range, the newest first; of all robots without one."""
    return _newest(cloud, robot, lambda table, name: table.findings(name, start_us, end_us), most)


def drives(
    cloud: Cloud,
    robot: str | None = None,
    start_us: int | None = None,
    end_us: int | None = None,
    *,
    most: int | None = None,
) -> list[AnalysedDrive]:
    """As `findings`, analysed drives."""
    return _newest(cloud, robot, lambda table, name: table.drives(name, start_us, end_us, most=most), most)


def notes(
    cloud: Cloud,
    robot: str | None = None,
    start_us: int | None = None,
    end_us: int | None = None,
    *,
    most: int | None = None,
) -> list[Note]:
    """As `findings`, notes about a range."""
    return _newest(cloud, robot, lambda table, name: table.notes(name, start_us, end_us, most=most), most)


def _newest(
    cloud: Cloud, robot: str | None, read: Callable[[FindingsTable, str], Iterator[_T]], most: int | None
) -> list[_T]:
    table = findings_table(cloud)
    rows = [row for name in robots_of(cloud, robot) for row in islice(read(table, name), most)]
    return sorted(rows, key=_key, reverse=True)[:most]


def _key(row: Finding | AnalysedDrive | Note) -> str:
    return str(row.drive) if isinstance(row, AnalysedDrive) else row.id


def write_note(
    cloud: Cloud, robot: str, text: str, *, by: str, t_us: int | None = None, keep_us: int = 0
) -> Note:
    """Write a note about a registered robot at a time; the default is now. The robot's recorder keeps what is
    ``keep_us`` before that time; nothing for 0.

    Raises `UsageError` for a text that is empty or too long, for a time that no recorder keeps, and if the
    robot's shadow has no room for what is to be kept. Then nothing is written.
    """
    registry.get(cloud, robot)
    at_us = time.time_ns() // 1000 if t_us is None else t_us
    note = Note(robot, at_us, text.strip(), by, secrets.token_hex(4))
    try:
        check_note(note)
        taken = recorder.new_take(at_us - keep_us, at_us, by=by, why=note.text) if keep_us else None
    except ContractError as error:
        raise UsageError(f"{error}; nothing is written") from error
    # First what may be refused: who tries again would write the note twice.
    if taken is not None:
        recorder.send_take(cloud, robot, taken)
    findings_table(cloud).put_note(note)
    return note


def remove_note(cloud: Cloud, robot: str, note_id: str) -> None:
    """Delete a note; raises `StationError` if the robot has none of this id."""
    registry.checked(robot)
    try:
        check_note_id(note_id)
    except ContractError as error:
        raise UsageError(str(error)) from error
    if not findings_table(cloud).remove_note(robot, note_id):
        raise StationError(f"{robot} has no note {note_id}; `iort note {robot}` lists them")


GAIN = "speed_to_erpm_gain"
_NUMBER = re.compile(r"\d[\d.,]*")


class Calibrated(NamedTuple):
    """A parameter over ``drives`` drives."""

    estimate: Estimate
    drives: int


class Calibration(NamedTuple):
    """The parameters that drives gave, and why the drives did not give the others."""

    found: Mapping[str, Calibrated]
    missing: Mapping[str, str]


def calibration(drives: Sequence[AnalysedDrive]) -> Calibration:
    """The car's parameters from drives, the newest first. A state, such as the battery's charge, is the
    newest drive's."""
    # numpy takes longer to load than most commands to run.
    from iort_analysis.baselines import combined  # noqa: PLC0415 - see above

    found: dict[str, Calibrated] = {}
    missing: dict[str, str] = {}
    for parameter in chain.from_iterable(GROUPS.values()):
        name = parameter.name
        known = [drive.estimates[name] for drive in drives if name in drive.estimates]
        if known:
            used = known[:1] if parameter.state else known
            found[name] = Calibrated(combined(used), len(used))
        elif reasons := [drive.missing[name] for drive in drives if name in drive.missing]:
            missing[name] = _reasons(reasons)
    return Calibration(found, missing)


def _reasons(reasons: Sequence[str]) -> str:
    """The drives' reasons, the most frequent first, each with the number of drives that give it.

    Reasons that differ in their numbers alone are one, with the newest drive's numbers.
    """
    alike: dict[str, list[str]] = {}
    for reason in reasons:
        alike.setdefault(_NUMBER.sub("#", reason), []).append(reason)
    if len(alike) == 1:
        return reasons[0]
    ranked = sorted(alike.values(), key=len, reverse=True)
    return "; ".join(f"{same[0]} ({len(same)} of {len(reasons)} drives)" for same in ranked)


def vesc_yaml(calibrated: Calibration, vehicle: Vehicle | None) -> str:
    """The lines of the car's vesc.yaml; empty if the drives did not tell the gain.

    The offset stays what it is: a ratio of distances does not depend on it.
    """
    gain = calibrated.found.get(GAIN)
    if gain is None:
        return ""
    low, high = (f"{value:.1f}" for value in (gain.estimate.low, gain.estimate.high))
    offset = 0.0 if vehicle is None else vehicle.speed_to_erpm_offset
    return (
        f"{GAIN}: {gain.estimate.value:.1f}  # {low} to {high} {gain.estimate.unit}\n"
        f"speed_to_erpm_offset: {offset:.1f}\n"
    )
