"""The settings that an operator may change while a robot's agent runs: their names and allowed values.

A name is a dotted path, the same in car.yaml and in the shadow. ``fields.<stream>`` selects the fields of a
stream.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Mapping, Sequence

from iort_contract.checks import check_field, shown
from iort_contract.limits import LIVE_MAX_RATE_HZ, LIVE_MIN_RATE_HZ, ContractError
from iort_contract.topics import check_stream

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
