"""Applies the settings that the operator may change while the agent runs."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any, Iterable, Mapping

from iort_agent.common.schema import Place, allowed, did_you_mean, items, text
from iort_agent.errors import ConfigError
from iort_agent.lanes import RuntimeSettings
from iort_contract.checks import check_field
from iort_contract.messages.control.driving import NO_MOTION
from iort_contract.messages.control.settings import CHANGEABLE, FIELD_LIST, FIELDS, MOTION_STOPPED, SETTINGS
from iort_contract.messages.control.shadow import Rejection
from iort_contract.topics import check_stream

_PLACE = Place(Path("shadow agent"))
_FIELD_LIST = items(text(check_field), what=FIELD_LIST)


def overlay(
    base: RuntimeSettings,
    in_force: RuntimeSettings,
    desired: Mapping[str, Any],
    known_fields: Mapping[str, Iterable[str]],
    *,
    moves: bool = True,
) -> tuple[RuntimeSettings, dict[str, Rejection]]:
    """The base with the desired settings, and the rejected ones by name; these keep what is ``in_force``.

    ``known_fields`` holds the fields of the streams seen so far; only these can be selected. A robot that no
    command ``moves`` must not seem to be stopped. Only an explicit value ends an emergency stop, because a
    shadow may be deleted, or lost with its cloud. The file's own stop is the file's alone to end: whoever
    wrote it stands beside the robot.
    """
    values: dict[str, Any] = {"motion_stopped": in_force.motion_stopped}
    fields = dict(base.fields)
    rejected: dict[str, Rejection] = {}
    for name, value in desired.items():
        stream = name[len(FIELDS) + 1 :] if name.startswith(f"{FIELDS}.") else None
        attribute = name.replace(".", "_")
        try:
            if stream is not None:
                names = _selection(stream, value, known_fields.get(stream))
                if names:
                    fields[stream] = names
            elif name in SETTINGS:
                values[attribute] = allowed(SETTINGS[name])(value, _PLACE.child(name))
                if name == MOTION_STOPPED and value and not moves:
                    raise _PLACE.child(name).problem(NO_MOTION)
                if name == MOTION_STOPPED and not value and base.motion_stopped:
                    raise _PLACE.child(name).problem(
                        "car.yaml has motion: {stopped: true}; change it on the robot, and restart the agent"
                    )
            else:
                hint = did_you_mean(name, CHANGEABLE)
                raise _PLACE.child(name).problem(
                    f"cannot be changed{hint}; must be one of {', '.join(CHANGEABLE)}"
                )
        except ConfigError as error:
            rejected[name] = Rejection(value, str(error))
            if stream is not None:
                fields.update({stream: in_force.fields[stream]} if stream in in_force.fields else {})
            elif name in SETTINGS:
                values[attribute] = getattr(in_force, attribute)
    return dataclasses.replace(base, fields=fields, **values), rejected


def _selection(stream: str, value: Any, known: Iterable[str] | None) -> tuple[str, ...]:
    place = _PLACE.child(FIELDS).child(stream)
    text(check_stream)(stream, place)
    names: tuple[str, ...] = _FIELD_LIST(value, place)
    for name in names if known is not None else ():
        if name not in (known or ()):
            raise place.problem(f"the stream {stream} has no field {name}{did_you_mean(name, known or ())}")
    return names
