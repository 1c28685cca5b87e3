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
    """The trigger as the robot is to have it: with the other streams that its condition names, and the
    vehicle's parameters that its derived fields need.

    Raises `UsageError` for a trigger that no robot accepts, and `StationError` for one that cannot fire on
    this one: its streams, fields and topics must be recorded, except with ``new``.
    """
    try:
        rule = triggers.rule_of(trigger)
        # The recorder hears what a robot's sources give, and not what its agent says.
        streams = set(inventory.check_recorded(cloud, robot)) - OWN_STREAMS
        if rule is not None:
            trigger = _with_streams(rule, trigger, streams)
            trigger = _with_vehicle(cloud, robot, rule, trigger)
        triggers.check_trigger(trigger)
    except (ContractError, ExpressionError) as error:
        raise UsageError(f"{error}; nothing is changed") from error
    evaluator = triggers.evaluator_of(trigger)
    if evaluator is not None and (own := evaluator.streams & OWN_STREAMS):
        raise UsageError(f"{min(own)} is the agent's own stream, which fires no trigger; nothing is changed")
    if new:
        return trigger
    if evaluator is not None:
        _check_fires(cloud, robot, evaluator, streams)
    _check_topics(cloud, robot, trigger.topics, streams)
    return trigger


def _with_streams(rule: Rule, trigger: Trigger, streams: AbstractSet[str]) -> Trigger:
    if trigger.others:
        return trigger
    firsts = {first for first, dot, _ in (name.partition(".") for name in rule.fields) if dot}
    return replace(trigger, others=tuple(sorted(firsts & streams - {trigger.stream})))


def _with_vehicle(cloud: Cloud, robot: str, rule: Rule, trigger: Trigger) -> Trigger:
    needed = {field for name in rule.fields if PARAMETERS.get(field := name.rpartition(".")[2])}
    if not needed:
        return trigger
    vehicle = registry.vehicle_of(cloud, robot)
    if vehicle is None:
        field = min(needed)
        raise StationError(f"{field} needs the {PARAMETERS[field][0]} of {robot}, which the registry lacks")
    return replace(trigger, gain=vehicle.speed_to_erpm_gain, offset=vehicle.speed_to_erpm_offset)


def _check_fires(cloud: Cloud, robot: str, evaluator: Evaluator, streams: AbstractSet[str]) -> None:
    for stream in sorted(evaluator.streams - streams):
        raise _unknown(f"{robot} has no stream {stream}", [stream], streams, robot)
    newest = {stream: inventory.newest_block(cloud, robot, stream) for stream in sorted(evaluator.streams)}
    for stream, named in evaluator.fields.items():
        there = newest[stream].columns.keys()
        possible = there | {name for name in DERIVED if there >= set(SOURCES[name])}
        if missing := sorted({field for _, field in named} - possible):
            raise _unknown(f"{robot} has no {', '.join(missing)} in {stream}", missing, possible, robot)
    try:
        for t_us, stream, sample in _samples(newest):
            evaluator.sample(stream, t_us, sample)
        evaluator.finish()
    except MismatchError as error:
        raise UsageError(f"the condition cannot be evaluated: {error}; nothing is changed") from error


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
        compiled = re.compile(".*".join(map(re.escape, pattern.split("*"))))
        if not any(map(compiled.fullmatch, there)):
            raise _unknown(
                f"{robot} has no topic and no stream that matches {pattern}", [pattern], there, robot
            )


def _unknown(problem: str, names: Iterable[str], known: Iterable[str], robot: str) -> StationError:
    return unknown(f"{problem} {_NEW}", names, known, f"iort streams {robot}")
