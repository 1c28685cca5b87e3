"""What there is to ask for: robots, their parameters, their streams."""

from __future__ import annotations

from collections.abc import Set as AbstractSet
from contextlib import suppress
from dataclasses import replace

from iort_contract.catalog.derived import PARAMETERS, SOURCES, Vehicle
from iort_contract.catalog.streams import ACCOUNT_STREAM, OWN_STREAMS, TYPES_STREAM
from iort_contract.catalog.vesc import VESC_STREAM
from iort_contract.limits import ContractError
from iort_contract.messages.message_type import MessageType, message_type
from iort_contract.tables import ROBOT, STREAMS
from iort_station.cloud import Cloud
from iort_station.data import reading
from iort_station.data.selection import Selection
from iort_station.data.stored import ATTRIBUTES, Refused, blocks
from iort_station.data.times import iso
from iort_station.data.units import VESC_KIND
from iort_station.errors import StationError
from iort_station.fleet import registry

# Every driver's VescState has them, and hardly anything else.
_OF_A_VESC = frozenset({"voltage_input", "current_motor", "duty_cycle"})


def vehicle_of(cloud: Cloud, robot: str) -> Vehicle | None:
    """The robot's parameters in the registry; None where they are not there."""
    row = registry.find(cloud, robot)
    if row is None or not row.get("speed_to_erpm_gain"):
        return None
    return Vehicle(float(row["speed_to_erpm_gain"]), float(row.get("speed_to_erpm_offset", 0)))


def check_there(cloud: Cloud, robot: str, stream: str) -> None:
    """Raise `StationError` where a robot or its stream does not exist, naming those that do.

    What a robot that is no longer registered has sent stays, and is there.
    """
    if reading.outermost(cloud, robot, stream, newest=False) is not None:
        return
    has = ", ".join(streams_of(cloud, robot))
    if not has:
        check_registered(cloud, robot)
    raise StationError(f"{robot} has no stream {stream}; it has {has or 'sent nothing yet'}")


def check_registered(cloud: Cloud, robot: str) -> None:
    """Raise `StationError` where a robot is not registered, naming those that are."""
    if registry.find(cloud, robot) is None:
        known = sorted(str(row[ROBOT]) for row in registry.listed(cloud))
        raise StationError(f"there is no robot {robot}; there is {', '.join(known) or 'none at all'}")


def check_fields(cloud: Cloud, selection: Selection, there: AbstractSet[str]) -> None:
    """Raise `StationError` where the selection names a field that is not ``there``, naming those that are."""
    unknown = sorted(selection.named() - there)
    if not unknown:
        return
    stored = _fields(cloud, selection)
    possible = stored | {name for name, sources in SOURCES.items() if stored.issuperset(sources)}
    for name in unknown:
        if name in possible and PARAMETERS[name]:
            parameter = PARAMETERS[name][0]
            raise StationError(f"{name} needs the {parameter} of {selection.robot}, which the registry lacks")
    raise StationError(
        f"{selection.robot} has no {', '.join(unknown)} in {selection.stream} in this range; "
        f"it has {', '.join(sorted(possible))}"
    )


def kind_of(cloud: Cloud, selection: Selection) -> MessageType | None:
    """The type that a stream's messages have, by which their units are known: what the robot has said of it,
    the last before the range ends, or else the first. A stream of which it has said nothing, as of a VESC's
    log or serial port, is a VESC's where it has the fields of one."""
    if selection.stream in {VESC_STREAM, *OWN_STREAMS}:
        return None
    kinds = []
    types = reading.batches(cloud, Selection(robot=selection.robot, stream=TYPES_STREAM), ATTRIBUTES)
    for block in blocks(types, Refused()):
        names = block.columns.get("stream", ())
        for i in [i for i, name in enumerate(names) if name == selection.stream]:
            with suppress(ContractError):
                sample = {name: column[i] for name, column in block.columns.items()}
                kinds.append((int(block.times_us[i]), message_type(sample)))
    end_us = selection.end_us
    before = [kind for t_us, kind in kinds if end_us is None or t_us < end_us]
    if kinds:
        return before[-1] if before else kinds[0][1]
    there = _fields(cloud, selection)
    return MessageType(selection.stream, "", VESC_KIND, "", "") if there.issuperset(_OF_A_VESC) else None


def streams_of(cloud: Cloud, robot: str) -> list[str]:
    """The streams of a robot that have something stored, as far as they are `known`."""
    names = known(cloud, robot)
    return [name for name in names if reading.outermost(cloud, robot, name, newest=True) is not None]


def known(cloud: Cloud, robot: str) -> list[str]:
    """Every stream that the robot's agent has said that it has, that Lambda 2 has seen, or that every robot
    may have."""
    row = registry.find(cloud, robot) or {}
    seen = {str(name) for name in row.get(STREAMS, ())}
    said = {
        name
        for own in (TYPES_STREAM, ACCOUNT_STREAM)
        for block in blocks(reading.batches(cloud, Selection(robot=robot, stream=own), ATTRIBUTES), Refused())
        for name in block.columns.get("stream", ())
        if isinstance(name, str)
    }
    return sorted({VESC_STREAM, *OWN_STREAMS, *seen, *said})


def _fields(cloud: Cloud, selection: Selection) -> set[str]:
    """The fields of the first samples stored in the selection's range."""
    whole = replace(selection, fields=None, condition=None)
    page = next(reading.batches(cloud, whole, ATTRIBUTES), ())
    return {name for block in blocks([page], Refused()) for name in block.columns}


def extent(cloud: Cloud, robot: str, stream: str) -> tuple[str, str] | None:
    """When a stream's oldest and newest batches start, as ISO 8601; None where there is none."""
    first = reading.outermost(cloud, robot, stream, newest=False)
    last = reading.outermost(cloud, robot, stream, newest=True)
    return None if first is None or last is None else (iso(first), iso(last))
