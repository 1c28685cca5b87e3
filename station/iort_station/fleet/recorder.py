"""A robot's event recorder, by its shadow: the triggers that it is to have, what an operator takes, and the
robot's answers.

Whether a trigger can fire on a robot is for `iort_station.data.triggers` to see before it is added.
"""

from __future__ import annotations

import secrets
import time
from collections.abc import Callable, Collection, Generator, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

from iort_contract.limits import ContractError
from iort_contract.messages import recorder as messages
from iort_contract.messages.recorder import MAX_TRIGGERS, MAX_WHY, Take, Trigger
from iort_contract.tables import ONLINE
from iort_contract.topics import ACCEPTED
from iort_station.cloud import Cloud
from iort_station.errors import StationError, UsageError, unknown
from iort_station.fleet import registry
from iort_station.fleet.control import Shadow, State, read, slept

# Others may change the shadow at the same time; each time one of them has done.
_TRIES = 20
# A fleet is read at once, not robot by robot.
_AT_ONCE = 32
# A robot that the registry does not yet know to be connected may still answer.
_OFFLINE_S = 2.0
# After this, an answer that is as it was before is one to the change.
_SAME_S = 4.0


class RobotTrigger(NamedTuple):
    """A trigger that a robot is to have, and its ``answer``: `ACCEPTED`, why not, or nothing yet. ``trigger``
    is None if this station cannot read it; ``problem`` says why."""

    robot: str
    name: str
    trigger: Trigger | None
    answer: str = ""
    problem: str = ""


class Answer(NamedTuple):
    """A robot's answer to a change: `ACCEPTED`, why not, or nothing yet; and whether it is connected."""

    text: str
    online: bool

    @property
    def refused(self) -> bool:
        """Whether the robot says why not."""
        return self.text not in {"", ACCEPTED}


def triggers(cloud: Cloud, robots: Collection[str]) -> list[RobotTrigger]:
    """The triggers that robots are to have, by robot and name, beside the robots' answers."""
    # Threads share a client, and must not make it at the same time.
    data = cloud.client("iot-data")
    with ThreadPoolExecutor(_AT_ONCE) as pool:
        each = pool.map(lambda robot: (robot, read(data, registry.checked(robot))), robots)
        return [row for robot, state in each for row in _listed(robot, state)]


def _listed(robot: str, state: State) -> Iterator[RobotTrigger]:
    for name, content in sorted(state.desired.recorder.triggers.items()):
        trigger, problem = None, ""
        try:
            trigger = messages.decode_trigger(name, content)
        except ContractError as error:
            problem = str(error)
        yield RobotTrigger(robot, name, trigger, state.reported.recorder.get(name, ""), problem)


def add(cloud: Cloud, robot: str, trigger: Trigger, seconds: float, *, withdraw: bool = True) -> Answer:
    """Add a trigger, or replace that of its name, and wait for the robot's answer.

    One that it refuses is taken back with ``withdraw``: what was there before stays. Raises `UsageError` for
    a trigger that no agent accepts, and for one too many.
    """
    return slept(adding(cloud, robot, trigger, seconds, withdraw=withdraw))


def adding(
    cloud: Cloud,
    robot: str,
    trigger: Trigger,
    seconds: float,
    *,
    withdraw: bool = True,
    replaces: Callable[[Trigger], bool] = lambda _old: True,
) -> Generator[None, None, Answer]:
    """As `add`; it yields where that sleeps. Raises `UsageError` for a name whose trigger it must not
    replace."""
    shadow, old = Shadow(cloud, robot), State()

    def change(state: State) -> Mapping[str, Any]:
        nonlocal old
        old = state
        there = state.desired.recorder.triggers
        if trigger.name not in there and len(there) >= MAX_TRIGGERS:
            raise UsageError(
                f"{robot} has {len(there)} triggers, the most allowed: {', '.join(sorted(there))}. "
                "`iort recorder remove` removes one"
            )
        _check_may(robot, there, trigger.name, replaces)
        return messages.encode_trigger(trigger)

    _change(shadow, change)
    before = old.reported.recorder.get(trigger.name, "")
    answer = yield from _answering(shadow, cloud, trigger.name, seconds, before)
    if withdraw and answer.refused:
        _change(shadow, lambda _: _restored(old, trigger.name))
    return answer


def remove(
    cloud: Cloud, robot: str, name: str, *, removes: Callable[[Trigger], bool] = lambda _old: True
) -> None:
    """Remove a trigger; raises `StationError` if the robot is not to have one of this name, and `UsageError`
    if it must not be removed from here."""
    shadow = Shadow(cloud, robot)

    def change(state: State) -> Mapping[str, Any]:
        there = state.desired.recorder.triggers
        if name not in there:
            raise unknown(f"{robot} has no trigger {name}", [name], there, f"iort recorder list {robot}")
        _check_may(robot, there, name, removes)
        return {messages.RECORDER: {messages.TRIGGERS: {name: None}}}

    _change(shadow, change)


def _check_may(robot: str, there: Mapping[str, Any], name: str, may: Callable[[Trigger], bool]) -> None:
    try:
        allowed = name not in there or may(messages.decode_trigger(name, there[name]))
    except ContractError:
        allowed = may(Trigger(name))
    if not allowed:
        raise UsageError(f"{robot} has a trigger {name} that keeps messages: `iort recorder` changes it")


def new_take(from_us: int, to_us: int, *, by: str, why: str = "", topics: Collection[str] = ()) -> Take:
    """A new take; raises `ContractError` for one that no agent accepts. Texts are cut to what it may have."""
    return messages.check_take(
        Take(secrets.token_hex(8), from_us, to_us, by[:MAX_WHY], why[:MAX_WHY], tuple(topics))
    )


def send_take(cloud: Cloud, robot: str, taken: Take) -> None:
    """Have a robot keep what its ring has of a take, without waiting for it: one that is not connected does
    so when it is back, as far as its ring reaches. Takes in the shadow that the robot has answered give way,
    then the oldest. Raises `UsageError` if there is no room."""

    def change(state: State) -> Mapping[str, Any]:
        return messages.encode_take(taken, state.desired.recorder.takes, state.reported.recorder)

    _change(Shadow(cloud, robot), change)


def take(
    cloud: Cloud,
    robot: str,
    from_us: int,
    to_us: int,
    *,
    by: str,
    why: str = "",
    topics: Collection[str] = (),
) -> Take:
    """As `send_take`, with a new take between two times of the robot's clock.

    Raises `UsageError` for a range that no agent accepts.
    """
    try:
        taken = new_take(from_us, to_us, by=by, why=why, topics=topics)
    except ContractError as error:
        raise UsageError(f"{error}; nothing is taken") from error
    send_take(cloud, robot, taken)
    return taken


def take_answer(cloud: Cloud, robot: str, taken: Take, seconds: float) -> Answer:
    """Wait for the robot's answer to a take."""
    return slept(take_answering(cloud, robot, taken, seconds))


def take_answering(cloud: Cloud, robot: str, taken: Take, seconds: float) -> Generator[None, None, Answer]:
    """As `take_answer`; it yields where that sleeps."""
    return _answering(Shadow(cloud, robot), cloud, taken.id, seconds)


def _answering(
    shadow: Shadow, cloud: Cloud, name: str, seconds: float, old: str = ""
) -> Generator[None, None, Answer]:
    online = bool(registry.get(cloud, shadow.robot).get(ONLINE))
    same_from = time.monotonic() + _SAME_S

    def answered(state: State) -> str | None:
        text = state.reported.recorder.get(name, "")
        return text if text and (text != old or time.monotonic() >= same_from) else None

    found = yield from shadow.waiting(answered, seconds if online else min(seconds, _OFFLINE_S))
    return Answer(found or "", online)


def _restored(before: State, name: str) -> Mapping[str, Any]:
    """The change that brings back what was there before."""
    content = before.desired.recorder.triggers.get(name)
    try:
        return messages.encode_trigger(messages.decode_trigger(name, content))
    except ContractError:
        return messages.encode_removal(name)


def _change(shadow: Shadow, change: Callable[[State], Mapping[str, Any]]) -> None:
    """Change the shadow by its present state, though others may change it too."""
    for _ in range(_TRIES):
        state = shadow.read()
        try:
            shadow.desire(messages.check_room(state.desired.recorder, change(state)), state.version)
        except shadow.data.exceptions.ConflictException:
            continue
        except ContractError as error:
            raise UsageError(f"{error}; nothing is changed") from error
        return
    raise StationError(f"others change the shadow of {shadow.robot} all the time: try again")
