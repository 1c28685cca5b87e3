"""A robot's event recorder, by its shadow: the triggers that it is to have, what an operator takes, and the
robot's answers."""

from __future__ import annotations

import secrets
from collections.abc import Callable, Mapping
from typing import Any

from iort_contract.limits import ContractError
from iort_contract.messages.recorder import Take, encode_take
from iort_station.cloud import Cloud
from iort_station.errors import StationError, UsageError
from iort_station.fleet.control import Shadow, State

# Others may change the shadow at the same time; each time one of them has done.
_TRIES = 20


def take(
    cloud: Cloud,
    robot: str,
    from_us: int,
    to_us: int,
    *,
    by: str,
    why: str = "",
    topics: tuple[str, ...] = (),
) -> Take:
    """Have a robot keep what its ring has between two times of its clock, without waiting for it: one that
    is not connected does so when it is back, as far as its ring reaches.

    The oldest takes in the shadow give way. Raises `UsageError` for a range that no agent accepts.
    """
    taken = Take(secrets.token_hex(8), from_us, to_us, by, why, topics)
    _change(Shadow(cloud, robot), lambda state: encode_take(taken, state.desired.recorder.takes))
    return taken


def _change(shadow: Shadow, change: Callable[[State], Mapping[str, Any]]) -> None:
    """Change the shadow by its present state, though others may change it too."""
    for _ in range(_TRIES):
        state = shadow.read()
        try:
            shadow.desire(change(state), state.version)
        except shadow.data.exceptions.ConflictException:
            continue
        except ContractError as error:
            raise UsageError(f"{error}; nothing is changed") from error
        return
    raise StationError(f"others change the shadow of {shadow.robot} all the time: try again")
