"""The settings of a running agent: reads what is typed, changes them, and waits for the agent's answer."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from typing import Any, NamedTuple

from iort_contract.limits import ContractError
from iort_contract.messages.control.settings import FIELDS, SETTINGS, Choice, check_name, check_setting
from iort_contract.messages.control.shadow import Rejection
from iort_contract.tables import ONLINE
from iort_station.cloud import Cloud
from iort_station.errors import UsageError
from iort_station.fleet import registry
from iort_station.fleet.control.shadow import Shadow, State, answered

# How long a robot may take to return to the file's value.
_WITHDRAWN_S = 3.0
# A robot that the registry does not yet know to be connected may still answer.
_OFFLINE_S = 2.0


class Changed(NamedTuple):
    """The shadow after a change, what the robot rejected of it, and whether it answered in time."""

    state: State
    rejected: Mapping[str, Rejection]
    online: bool
    answered: bool


def parsed(name: str, text: str) -> Any:
    """The value of a setting that somebody has typed; raises `UsageError` for one that no agent accepts."""
    value: Any = text
    if name.startswith(f"{FIELDS}."):
        value = [field.strip() for field in text.split(",") if field.strip()]
    elif not isinstance(SETTINGS.get(name), Choice):
        with suppress(ValueError):  # refused below
            value = json.loads(text)
    with _nothing_changed():
        check_setting(name, value)
    return value


@contextmanager
def _nothing_changed() -> Iterator[None]:
    try:
        yield
    except ContractError as error:
        raise UsageError(f"{error}; nothing is changed") from error


def written(value: Any) -> str:
    """A setting's value as somebody types it."""
    if isinstance(value, float) and value.is_integer():
        value = int(value)
    return ",".join(map(str, value)) if isinstance(value, list) else json.dumps(value).strip('"')


def change(cloud: Cloud, robot: str, wanted: Mapping[str, Any], seconds: float) -> Changed:
    """Desire settings by dotted name, and wait for the robot; None returns to the file's value.

    A change that the robot rejects is withdrawn: the last accepted value stays in force. The values must have
    passed `check_setting`. Raises `StationError` for an unknown robot, and `UsageError` for an unknown
    setting that is not desired either.
    """
    shadow = Shadow(cloud, robot)
    online = bool(registry.get(cloud, robot).get(ONLINE))
    before = shadow.read()
    with _nothing_changed():
        for name in wanted.keys() - before.desired.settings.keys():
            check_name(name)
    in_time = _change_and_wait(shadow, before, wanted, seconds if online else min(seconds, _OFFLINE_S))
    state = shadow.read()
    rejected = {name: one for name, one in state.rejected().items() if name in wanted}
    _withdraw(shadow, before, state, {name: wanted[name] for name in rejected})
    return Changed(state, rejected, online, in_time)


def _change_and_wait(shadow: Shadow, before: State, wanted: Mapping[str, Any], seconds: float) -> bool:
    """Request the changes; whether the robot has answered in time."""
    shadow.desire(wanted)
    if shadow.wait(lambda state: answered(wanted, state), seconds) is None:
        return False
    old, requested = before.reported.settings, before.desired.settings
    withdrawn = [n for n, value in wanted.items() if value is None and requested.get(n) == old.get(n)]
    if withdrawn:
        # The file may hold the same value, which the robot does not report again.
        shadow.wait(
            lambda state: all(state.reported.settings.get(n) != old.get(n) for n in withdrawn) or None,
            min(seconds, _WITHDRAWN_S),
        )
    return True


def _withdraw(shadow: Shadow, before: State, state: State, rejected: Mapping[str, Any]) -> None:
    """Replace rejected changes by the desired values before them, unless somebody has changed them since."""
    old, now = before.desired.settings, state.desired.settings
    known = before.rejected()
    again = {
        name: None if name in known else old.get(name)
        for name, value in rejected.items()
        if now.get(name) == value
    }
    if again:
        shadow.desire(again)
