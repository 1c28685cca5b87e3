"""Alarms on a condition of one's own, for the live page: triggers of robots' event recorders that only tell.

Those that keep messages are listed, and changed by `iort recorder`.
"""

from __future__ import annotations

from collections.abc import Generator, Mapping

from iort_contract.messages import insights as messages
from iort_contract.messages.page import DryRunAnswer, TriggersAnswer
from iort_contract.messages.recorder import MAX_COOLDOWN_S, Trigger
from iort_contract.topics import ACCEPTED
from iort_station.cloud import Cloud
from iort_station.data import triggers as checks
from iort_station.data.dry_run import dry_run
from iort_station.errors import StationError
from iort_station.fleet import recorder
from iort_station.page.requests import robot_of, text, whole

# A robot that is connected looks once a second.
_ANSWER_S = 15.0
# Every sample is evaluated: an hour at 50 Hz takes seconds.
_LONGEST_US = 24 * 3_600_000_000
_TIMES = 200


def triggers(cloud: Cloud, request: Mapping[str, str]) -> TriggersAnswer:
    """The triggers of ``robot``."""
    return {
        "triggers": [
            {
                "name": row.name,
                "stream": "" if row.trigger is None else row.trigger.stream,
                "when": row.problem if row.trigger is None else row.trigger.when or f"on {row.trigger.on}",
                "cooldown_s": 0.0 if row.trigger is None else row.trigger.cooldown_s,
                "notify": row.trigger is not None and row.trigger.notify,
                "answer": row.answer,
            }
            for row in recorder.triggers(cloud, [robot_of(request)])
        ]
    }


def count(cloud: Cloud, request: Mapping[str, str]) -> DryRunAnswer:
    """How often the condition ``when`` became true in ``stream`` from ``from_us`` to ``to_us``. Raises
    `StationError` for a range of more than a day, and as `dry_run`."""
    start_us, end_us = (whole(request, name, 0, 2**53) for name in ("from_us", "to_us"))
    if not 0 < end_us - start_us <= _LONGEST_US:
        raise StationError(
            "the range must be at most a day, and end after its start: `iort recorder dry-run` counts more"
        )
    found = dry_run(cloud, robot_of(request), _trigger(request, "alarm"), start_us, end_us)
    return {
        "edges": len(found.edges),
        "told": len(found.windows),
        "samples": found.samples,
        "times_s": [edge.t_us / 1e6 for edge in found.edges[:_TIMES]],
    }


def add(cloud: Cloud, request: Mapping[str, str]) -> Generator[None, None, messages.KeepAnswer]:
    """Have ``robot`` tell when the condition ``when`` on ``stream`` becomes true, under a ``name``. It yields
    while it waits for the robot's answer. What the robot refuses is taken back."""
    robot = robot_of(request)
    trigger = checks.checked(cloud, robot, _trigger(request, text(request, "name")))
    answer = yield from recorder.adding(cloud, robot, trigger, _ANSWER_S, replaces=_only_tells)
    accepted = answer.text == ACCEPTED if answer.text else None
    return {"accepted": accepted, "reason": answer.text if answer.refused else "", "online": answer.online}


def remove(cloud: Cloud, request: Mapping[str, str]) -> TriggersAnswer:
    """Remove the trigger ``name`` of ``robot``, if it only tells."""
    recorder.remove(cloud, robot_of(request), text(request, "name"), removes=_only_tells)
    return triggers(cloud, request)


def _trigger(request: Mapping[str, str], name: str) -> Trigger:
    cooldown_s = whole(request, "cooldown_s", 1, int(MAX_COOLDOWN_S))
    stream, when = text(request, "stream"), text(request, "when")
    return Trigger(name, when, stream=stream, cooldown_s=float(cooldown_s), notify=True)


def _only_tells(trigger: Trigger) -> bool:
    return trigger.notify
