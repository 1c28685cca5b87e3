"""Whether a trigger of the event recorder can fire on a robot, by what is recorded of it."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from collections.abc import Set as AbstractSet
from dataclasses import replace

from iort_analysis.samples.blocks import Block, values
from iort_contract import triggers
from iort_contract.catalog.derived import DERIVED, PARAMETERS, SOURCES
from iort_contract.catalog.streams import OWN_STREAMS
from iort_contract.expression import ExpressionError, MismatchError
from iort_contract.limits import ContractError
from iort_contract.messages.recorder import Trigger
from iort_contract.triggers import Evaluator, Rule
from iort_station.cloud import Cloud
from iort_station.data import inventory
from iort_station.errors import StationError, UsageError, unknown
from iort_station.fleet import registry

# So many of the newest samples are tried.
_TRIED = 500
_NEW = "(with --new it is added all the same)"


def checked(cloud: Cloud, robot: str, trigger: Trigger, *, new: bool = False) -> Trigger:
    """As `prepared`, if the trigger can fire on the robot: its streams, fields and topics are recorded, or
    ``new``. Raises `StationError` otherwise, and as `prepared`."""
    streams = recorded_streams(cloud, robot)
    trigger = prepared(cloud, robot, trigger, streams)
    evaluator = triggers.evaluator_of(trigger)
    if evaluator is not None and (own := evaluator.streams & OWN_STREAMS):
        raise UsageError(f"{min(own)} is the agent's own stream, which fires no trigger")
    if not new:
        if evaluator is not None:
            _check_fires(cloud, robot, evaluator, streams)
        _check_topics(cloud, robot, trigger.topics, streams)
    return trigger


def prepared(cloud: Cloud, robot: str, trigger: Trigger, streams: AbstractSet[str]) -> Trigger:
    """The trigger as the robot is to have it: with those of its ``streams`` that the condition names, and
    with the vehicle's parameters that derived fields need, unless it has its own.

    Raises `UsageError` for a trigger that no robot accepts, and `StationError` without these parameters.
    """
    try:
        rule = triggers.rule_of(trigger)
        if rule is not None:
            trigger = _with_streams(rule, trigger, streams)
            trigger = _with_vehicle(cloud, robot, rule, trigger)
        return triggers.check_trigger(trigger)
    except (ContractError, ExpressionError) as error:
        raise UsageError(str(error)) from error


def recorded_streams(cloud: Cloud, robot: str) -> set[str]:
    """The streams that the recorder hears, as far as they are recorded: those of the robot's sources, and not
    what its agent says."""
    return set(inventory.check_recorded(cloud, robot)) - OWN_STREAMS


def _with_streams(rule: Rule, trigger: Trigger, streams: AbstractSet[str]) -> Trigger:
    if trigger.others:
        return trigger
    firsts = {first for first, dot, _ in (name.partition(".") for name in rule.fields) if dot}
    return replace(trigger, others=tuple(sorted(firsts & streams - {trigger.stream})))


def _with_vehicle(cloud: Cloud, robot: str, rule: Rule, trigger: Trigger) -> Trigger:
    fields = (name.rpartition(".")[2] for name in rule.fields)
    needed = sorted(field for field in fields if PARAMETERS.get(field))
    if not needed or trigger.gain:
        return trigger
    vehicle = registry.vehicle_of(cloud, robot)
    if vehicle is None:
        parameter = PARAMETERS[needed[0]][0]
        raise StationError(f"{needed[0]} needs the {parameter} of {robot}, which the registry lacks")
    return replace(trigger, gain=vehicle.speed_to_erpm_gain, offset=vehicle.speed_to_erpm_offset)


def fits(patterns: Iterable[str], *names: str) -> bool:
    """Whether one of the names is one of the patterns', in which ``*`` stands for any characters."""
    compiled = [re.compile(".*".join(map(re.escape, pattern.split("*")))) for pattern in patterns]
    return any(pattern.fullmatch(name) for pattern in compiled for name in names)


def _check_fires(cloud: Cloud, robot: str, evaluator: Evaluator, streams: AbstractSet[str]) -> None:
    for stream in sorted(evaluator.streams - streams):
        raise _unknown(f"{robot} has no stream {stream}", [stream], streams, robot)
    newest = {stream: inventory.newest_block(cloud, robot, stream) for stream in sorted(evaluator.streams)}
    for stream, named in evaluator.fields.items():
        # Since then, fewer fields may be recorded; the trigger is evaluated on all.
        there = newest[stream].columns.keys() | inventory.first_fields(cloud, robot, stream)
        possible = there | {name for name in DERIVED if there >= set(SOURCES[name])}
        if missing := sorted({field for _, field in named} - possible):
            raise _unknown(f"{robot} has no {', '.join(missing)} in {stream}", missing, possible, robot)
    try:
        for t_us, stream, sample in _samples(newest):
            evaluator.sample(stream, t_us, sample)
        evaluator.finish()
    except MismatchError as error:
        raise UsageError(f"the condition cannot be evaluated: {error}") from error


def _samples(newest: Mapping[str, Block]) -> list[tuple[int, str, Mapping[str, object]]]:
    """The newest samples of each stream, in order of time."""
    found: list[tuple[int, str, Mapping[str, object]]] = []
    for stream, block in newest.items():
        last = block.take(slice(max(0, len(block.times_us) - _TRIED), len(block.times_us)))
        columns = {name: values(column) for name, column in last.columns.items()}
        for i, t_us in enumerate(last.times_us.tolist()):
            found.append((t_us, stream, {name: column[i] for name, column in columns.items()}))
    return sorted(found, key=lambda each: each[0])


def _check_topics(cloud: Cloud, robot: str, patterns: Sequence[str], streams: AbstractSet[str]) -> None:
    if not patterns:
        return
    there = {*streams, *(kind.topic for _, kind in inventory.types_of(cloud, robot) if kind.topic)}
    for pattern in patterns:
        if not fits([pattern], *there):
            raise _unknown(
                f"{robot} has no topic and no stream that matches {pattern}", [pattern], there, robot
            )


def _unknown(problem: str, names: Iterable[str], known: Iterable[str], robot: str) -> StationError:
    return unknown(f"{problem} {_NEW}", names, known, f"iort streams {robot}")
