"""The settings that the operator may change while the agent runs: their names, rules and values.

A name is a dotted path, the same in car.yaml and in the shadow; ``fields.<stream>`` is the selection
of a stream's fields.
"""

from __future__ import annotations

import dataclasses
import difflib
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Iterator, Mapping

from iort_agent.errors import ConfigError
from iort_agent.lanes.config import LiveConfig, PingConfig, RecordConfig
from iort_agent.logs import LOG_LEVELS
from iort_agent.schema import Rule, Where, choice, items, text
from iort_contract.checks import check_field
from iort_contract.topics import check_stream

# Errors name the place as those of a configuration file do.
_WHERE = Where(Path("shadow agent"))
FIELDS = "fields"
_FIELD_LIST = items(text(check_field), what="a list of field names; an empty one means all fields")


@dataclass(frozen=True)
class Tuning:
    """What is in force. ``fields`` maps a stream to the only fields that are sent of it; a stream that
    is not there is sent whole."""

    record_enabled: bool
    live_enabled: bool
    live_rate_hz: float
    ping_rate_hz: float
    log_level: str
    fields: Mapping[str, tuple[str, ...]] = field(default_factory=dict)

    def as_document(self) -> dict[str, Any]:
        """As the shadow reports it."""
        return {
            "record": {"enabled": self.record_enabled},
            "live": {"enabled": self.live_enabled, "rate_hz": self.live_rate_hz},
            "ping": {"rate_hz": self.ping_rate_hz},
            "log_level": self.log_level,
            FIELDS: {stream: list(names) for stream, names in sorted(self.fields.items())},
        }


def _rule(cls: type[Any], name: str) -> Rule:
    (rule,) = (f.metadata["rule"] for f in dataclasses.fields(cls) if f.name == name)
    return rule  # type: ignore[no-any-return]  # metadata is of any type


RULES: dict[str, Rule] = {
    "record.enabled": _rule(RecordConfig, "enabled"),
    "live.enabled": _rule(LiveConfig, "enabled"),
    "live.rate_hz": _rule(LiveConfig, "rate_hz"),
    "ping.rate_hz": _rule(PingConfig, "rate_hz"),
    "log_level": choice(*LOG_LEVELS),
}
_SECTIONS = {name.split(".")[0] for name in RULES if "." in name} | {FIELDS}


def configured(*, record: RecordConfig, live: LiveConfig, ping: PingConfig, log_level: str) -> Tuning:
    """What the configuration file says."""
    return Tuning(record.enabled, live.enabled, live.rate_hz, ping.rate_hz, log_level)


def overlay(
    base: Tuning, wished: Mapping[str, Any], known_fields: Mapping[str, Any]
) -> tuple[Tuning, dict[str, dict[str, Any]]]:
    """The base with the wishes that are allowed, and by name the value and reason of those that are not.

    ``known_fields`` holds the fields of the streams seen so far, of which others cannot be selected.
    """
    values: dict[str, Any] = {}
    fields = dict(base.fields)
    rejected: dict[str, dict[str, Any]] = {}
    for name, value in _flat(wished):
        try:
            if name.startswith(f"{FIELDS}."):
                stream = name[len(FIELDS) + 1 :]
                names = _selection(stream, value, known_fields.get(stream))
                if names:
                    fields[stream] = names
            elif name in RULES:
                values[name.replace(".", "_")] = RULES[name](value, _WHERE.child(name))
            else:
                allowed = [*RULES, f"{FIELDS}.<stream>"]
                close = difflib.get_close_matches(name, allowed, n=1)
                hint = f" (did you mean {close[0]}?)" if close else ""
                raise _WHERE.child(name).problem(f"cannot be changed; allowed is {', '.join(allowed)}{hint}")
        except ConfigError as error:  # noqa: PERF203 - one wrong wish must not cost the others
            rejected[name] = {"value": value, "reason": str(error)}
    return dataclasses.replace(base, fields=fields, **values), rejected


def _flat(wished: Mapping[str, Any]) -> Iterator[tuple[str, Any]]:
    for name, value in wished.items():
        if name in _SECTIONS and isinstance(value, dict):
            for inner, item in value.items():
                yield f"{name}.{inner}", item
        else:
            yield name, value


def _selection(stream: str, value: Any, known: Any) -> tuple[str, ...]:
    where = _WHERE.child(FIELDS).child(stream)
    text(check_stream)(stream, where)
    names: tuple[str, ...] = _FIELD_LIST(value, where)
    for name in names if known is not None else ():
        if name not in known:
            close = difflib.get_close_matches(name, list(known), n=1)
            hint = f"; did you mean {close[0]}?" if close else ""
            raise where.problem(f"the stream {stream} has no field {name}{hint}")
    return names
