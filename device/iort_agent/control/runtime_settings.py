"""The settings that the operator may change while the agent runs: their names and rules.

A name is a dotted path, the same in car.yaml and in the shadow. ``fields.<stream>`` selects a stream's
fields.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any, Iterable, Iterator, Mapping

from iort_agent.common.logs import LOG_LEVELS
from iort_agent.common.schema import Place, Rule, choice, did_you_mean, items, rules_of, text
from iort_agent.errors import ConfigError
from iort_agent.lanes.config import LiveConfig, PingConfig, RecordConfig, RuntimeSettings
from iort_contract.checks import check_field
from iort_contract.topics import check_stream

_PLACE = Place(Path("shadow agent"))
FIELDS = "fields"
_FIELD_LIST = items(text(check_field), what="a list of field names; an empty one means all fields")
RULES: dict[str, Rule] = {
    "record.enabled": rules_of(RecordConfig)["enabled"],
    "live.enabled": rules_of(LiveConfig)["enabled"],
    "live.rate_hz": rules_of(LiveConfig)["rate_hz"],
    "ping.rate_hz": rules_of(PingConfig)["rate_hz"],
    "log_level": choice(*LOG_LEVELS),
}
_SECTIONS = {name.split(".")[0] for name in RULES if "." in name} | {FIELDS}


def overlay(
    base: RuntimeSettings, desired: Mapping[str, Any], known_fields: Mapping[str, Iterable[str]]
) -> tuple[RuntimeSettings, dict[str, dict[str, Any]]]:
    """The base with the desired settings that are allowed; value and reason of each rejected one, by name.

    ``known_fields`` holds the fields of the streams seen so far; only these can be selected.
    """
    values: dict[str, Any] = {}
    fields = dict(base.fields)
    rejected: dict[str, dict[str, Any]] = {}
    for name, value in _flat(desired):
        try:
            if name.startswith(f"{FIELDS}."):
                stream = name[len(FIELDS) + 1 :]
                names = _selection(stream, value, known_fields.get(stream))
                if names:
                    fields[stream] = names
            elif name in RULES:
                values[name.replace(".", "_")] = RULES[name](value, _PLACE.child(name))
            else:
                allowed = [*RULES, f"{FIELDS}.<stream>"]
                hint = did_you_mean(name, allowed)
                raise _PLACE.child(name).problem(
                    f"cannot be changed{hint}; must be one of {', '.join(allowed)}"
                )
        except ConfigError as error:  # noqa: PERF203 - one wrong setting must not reject the others
            rejected[name] = {"value": value, "reason": str(error)}
    return dataclasses.replace(base, fields=fields, **values), rejected


def _flat(desired: Mapping[str, Any]) -> Iterator[tuple[str, Any]]:
    for name, value in desired.items():
        if name in _SECTIONS and isinstance(value, dict):
            for inner, item in value.items():
                yield f"{name}.{inner}", item
        else:
            yield name, value


def _selection(stream: str, value: Any, known: Iterable[str] | None) -> tuple[str, ...]:
    place = _PLACE.child(FIELDS).child(stream)
    text(check_stream)(stream, place)
    names: tuple[str, ...] = _FIELD_LIST(value, place)
    for name in names if known is not None else ():
        if name not in (known or ()):
            raise place.problem(f"the stream {stream} has no field {name}{did_you_mean(name, known or ())}")
    return names
