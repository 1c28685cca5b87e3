"""The event recorder: triggers and takes in the shadow's desired part, the agent's answers in its reported
part, and the samples of the stream `incidents`.

A trigger's condition is read by `iort_contract.triggers`, whose `check_trigger` checks a whole trigger.
"""

from __future__ import annotations

import hashlib
import json
import math
import re
from dataclasses import dataclass, field, fields
from itertools import islice
from typing import Any, Callable, Collection, Mapping, TypeVar

from iort_contract.checks import check_id, check_time, checked, shown
from iort_contract.limits import ContractError, Value
from iort_contract.messages.envelope import entries, read
from iort_contract.topics import ACCEPTED, NAME, check_stream

# Triggers of a robot, and takes that wait in its shadow, which has 8 KB in all.
MAX_TRIGGERS, MAX_TAKES = 8, 4
# The settings and the emergency stop need room there, whatever the recorder does: the bytes of all triggers
# and takes as JSON, and of all answers without their names.
MAX_WANTED_BYTES, MAX_ANSWERS_BYTES = 4_000, 1_200
MAX_TRIGGER_BYTES, MAX_WHEN, MAX_WHY = 600, 400, 160
MAX_TOPICS = 16
MAX_BEFORE_S = MAX_AFTER_S = 600.0
MAX_COOLDOWN_S = 86_400.0
MAX_BUDGET_MB = 1_000_000.0
# Windows that overlap are one incident up to this length; a take may be as long.
MAX_SPAN_S = 1_800.0
# What fires a trigger: its condition, or one of these.
CONDITION, STOP, DISCONNECT, FAULT, SERVICE, FINDING = "", "stop", "disconnect", "fault", "service", "finding"
EVENTS = (STOP, DISCONNECT, FAULT, SERVICE, FINDING)
# In the shadow.
RECORDER, TRIGGERS, TAKES = "recorder", "triggers", "takes"
# States of an incident.
KEPT, UPLOADED, NOTIFIED, OVER_BUDGET, LOST = "kept", "uploaded", "notified", "over_budget", "lost"
STATES = (KEPT, UPLOADED, NOTIFIED, OVER_BUDGET, LOST)
# Among an incident's triggers, that an operator took it.
TAKE = "take"
# In an incident's file: its two records of metadata, and what a channel's metadata has the stream as.
ABOUT_RECORD, ACCOUNT_RECORD = "iort.incident", "iort.account"
CHANNEL_STREAM = "iort_stream"

_TOPIC = re.compile(r"[A-Za-z0-9_/*~.-]{1,128}")
_US = 1_000_000
T = TypeVar("T")


@dataclass(frozen=True)
class Trigger:
    """A rule that says when to keep what.

    ``when`` is a condition on fields of the ``stream`` and, as ``other.field``, of the streams ``others``;
    or ``on`` is one of `EVENTS`. ``topics`` are patterns, with ``*``, of ROS topics or streams; none means
    all that the ring keeps. Within ``cooldown_s`` after an edge, further edges are ignored. ``budget_mb_day``
    is the most that is uploaded a day; 0 means no limit of its own. With ``notify``, nothing is kept.
    ``gain`` and ``offset`` are the vehicle's parameters for derived fields; a gain of 0 means unknown.
    """

    name: str
    when: str = ""
    on: str = CONDITION
    stream: str = "vesc"
    others: tuple[str, ...] = ()
    before_s: float = 30.0
    after_s: float = 10.0
    topics: tuple[str, ...] = ()
    cooldown_s: float = 60.0
    budget_mb_day: float = 0.0
    notify: bool = False
    gain: float = 0.0
    offset: float = 0.0

    @property
    def before_us(self) -> int:
        """How long the window begins before an edge."""
        return round(self.before_s * _US)

    @property
    def after_us(self) -> int:
        """How long the window ends after an edge."""
        return round(self.after_s * _US)

    @property
    def cooldown_us(self) -> int:
        """How long further edges are ignored: a second at least."""
        return max(_US, round(self.cooldown_s * _US))


@dataclass(frozen=True)
class Take:
    """An operator's word to keep what is between two times of the robot's clock."""

    id: str
    from_us: int
    to_us: int
    by: str = ""
    why: str = ""
    topics: tuple[str, ...] = ()


@dataclass(frozen=True)
class Wanted:
    """The recorder's desired part: triggers by name and takes by id, not checked; see `decode_trigger`."""

    triggers: Mapping[str, Any] = field(default_factory=dict)
    takes: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Incident:
    """What is kept of a window, as a sample of the stream `incidents`: one when it opens, and one at each
    change of its ``state``. ``trigger`` has the names, separated by commas. ``missing`` counts messages of
    the window that were there and are not in the file."""

    id: str
    trigger: str
    from_us: int
    to_us: int
    state: str
    condition: str = ""
    why: str = ""
    by: str = ""
    key: str = ""
    bytes: int = 0
    messages: int = 0
    missing: int = 0

    def sample(self) -> dict[str, Value]:
        """The incident as a sample."""
        return dict(vars(self))


def incident(sample: Mapping[str, Value]) -> Incident:
    """Decode a sample of the stream `incidents`; raises `ContractError`."""
    found = read(Incident, {name: value for name, value in sample.items() if value is not None})
    check_id(found.id, "incident id")
    if found.state not in STATES:
        raise ContractError(f"state must be one of {', '.join(STATES)}, got {shown(found.state)}")
    return found


def incident_id(robot: str, what: str, t_us: int) -> str:
    """The id of the incident that begins with an edge of a trigger, or with the take ``what`` and the time 0:
    the same one after a restart."""
    return hashlib.sha256(f"{robot}\0{what}\0{t_us}".encode()).hexdigest()[:16]


def check_limits(trigger: Trigger) -> Trigger:
    """Return the trigger if all but its condition is allowed; raises `ContractError`."""
    check_name(trigger.name)
    if trigger.on not in (CONDITION, *EVENTS):
        raise ContractError(f"on must be one of {', '.join(EVENTS)}, got {shown(trigger.on)}")
    if bool(trigger.when) == bool(trigger.on):
        raise ContractError("a trigger needs either a condition (when) or an event (on)")
    if len(trigger.when) > MAX_WHEN:
        raise ContractError(f"the condition must be at most {MAX_WHEN} characters, got {len(trigger.when)}")
    for stream in (trigger.stream, *trigger.others):
        check_stream(stream)
    _within("before", trigger.before_s, 0, MAX_BEFORE_S, "s")
    _within("after", trigger.after_s, 0, MAX_AFTER_S, "s")
    _within("cooldown", trigger.cooldown_s, 0, MAX_COOLDOWN_S, "s")
    _within("budget", trigger.budget_mb_day, 0, MAX_BUDGET_MB, "MB a day")
    if not math.isfinite(trigger.gain) or not math.isfinite(trigger.offset):
        raise ContractError("the vehicle's gain and offset must be finite numbers")
    _check_topics(trigger.topics)
    size = len(json.dumps(_entries(trigger, "name"), separators=(",", ":")))
    if size > MAX_TRIGGER_BYTES:
        raise ContractError(f"a trigger must be at most {MAX_TRIGGER_BYTES} bytes as JSON, got {size}")
    return trigger


def check_take(take: Take) -> Take:
    """Return the take if it is allowed; raises `ContractError`."""
    check_id(take.id, "take id")
    check_time(take.from_us, "from_us")
    check_time(take.to_us, "to_us")
    if not 0 < take.to_us - take.from_us <= MAX_SPAN_S * _US:
        raise ContractError(f"a take must span more than 0 and at most {MAX_SPAN_S:g} s")
    for what, said in (("by", take.by), ("why", take.why)):
        if len(said) > MAX_WHY:
            raise ContractError(f"{what} must be at most {MAX_WHY} characters, got {len(said)}")
    _check_topics(take.topics)
    return take


def check_name(name: str) -> str:
    """Return ``name`` if it may name a trigger."""
    return checked(NAME, name, "trigger name", "1 to 64 of A-Z a-z 0-9 _ -")


def decode_trigger(name: str, content: Any) -> Trigger:
    """A trigger of the shadow, its condition not checked; raises `ContractError`."""
    return check_limits(_named(Trigger, "name", name, content))


def decode_take(take_id: str, content: Any) -> Take:
    """A take of the shadow; raises `ContractError`."""
    return check_take(_named(Take, "id", take_id, content))


def encode_trigger(trigger: Trigger) -> dict[str, Any]:
    """The change of the desired part that adds a trigger, or replaces that of its name."""
    return {RECORDER: {TRIGGERS: {trigger.name: _replacing(check_limits(trigger), "name")}}}


def encode_removal(name: str) -> dict[str, Any]:
    """The change of the desired part that removes a trigger."""
    return {RECORDER: {TRIGGERS: {check_name(name): None}}}


def encode_take(take: Take, waiting: Mapping[str, Any], answered: Collection[str] = ()) -> dict[str, Any]:
    """The change of the desired part that adds a take to those ``waiting`` there. Those that the robot has
    ``answered`` give way first, and go anyway when they are old; then the oldest."""
    order = sorted(waiting, key=lambda other: (other not in answered, _end(waiting[other])))
    gone = order[: max(0, len(order) + 1 - MAX_TAKES)]
    old_us = take.to_us - round(MAX_SPAN_S * _US)
    gone += [other for other in order if other in answered and _end(waiting[other]) < old_us]
    return {RECORDER: {TAKES: {**dict.fromkeys(gone), take.id: _replacing(check_take(take), "id")}}}


def check_room(there: Wanted, change: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return a change of the desired part if the shadow has room for it beside what is ``there``; raises
    `ContractError`."""
    changed, before, after = _mapping(change.get(RECORDER)), 0, 0
    for name, now in ((TRIGGERS, there.triggers), (TAKES, there.takes)):
        before += _bytes(now)
        after += _bytes({**now, **_mapping(changed.get(name))})
    if after > max(before, MAX_WANTED_BYTES):
        raise ContractError(
            f"the triggers and takes of a robot must be at most {MAX_WANTED_BYTES} bytes together, "
            f"got {after}: its shadow has no more room"
        )
    return change


def decode_wanted(content: Any) -> Wanted:
    """The recorder's part of the desired settings."""
    content = _mapping(content)
    return Wanted(_mapping(content.get(TRIGGERS)), _mapping(content.get(TAKES)))


def decode_answers(content: Any) -> dict[str, str]:
    """The agent's answers by trigger: `ACCEPTED`, or why not."""
    return {name: answer for name, answer in sorted(_mapping(content).items()) if isinstance(answer, str)}


def encode_answers(answers: Mapping[str, str]) -> dict[str, str]:
    """The agent's answers, in few bytes: whoever writes the shadow may name more triggers than there are."""
    some = dict(islice(answers.items(), MAX_TRIGGERS + MAX_TAKES))
    refused = sum(answer != ACCEPTED for answer in some.values())
    most = min(MAX_WHY, MAX_ANSWERS_BYTES // max(1, refused))
    return {name: answer if answer == ACCEPTED else answer[:most] for name, answer in some.items()}


def _named(kind: Callable[..., T], key: str, name: str, content: Any) -> T:
    if not isinstance(content, Mapping):
        raise ContractError(f"{shown(name)} must be an object, got {shown(content)}")
    # A shadow that does not remove what is null has the default, too.
    content = {entry: value for entry, value in content.items() if value is not None}
    known = {one.name for one in fields(kind)}  # type: ignore[arg-type]  # a dataclass
    unknown = sorted(str(entry) for entry in content if entry not in known)
    if unknown:
        raise ContractError(f"unknown entry {shown(unknown[0])}; must be one of {', '.join(sorted(known))}")
    return read(kind, {**content, key: name})  # type: ignore[arg-type]  # a dataclass


def _entries(message: Any, key: str) -> dict[str, Any]:
    return {name: value for name, value in entries(message).items() if name != key}


def _replacing(message: Any, key: str) -> dict[str, Any]:
    """All entries, with null, which removes it from the shadow, for each at its default."""
    return {**{one.name: None for one in fields(message) if one.name != key}, **_entries(message, key)}


def _check_topics(topics: tuple[str, ...]) -> None:
    if len(topics) > MAX_TOPICS:
        raise ContractError(f"at most {MAX_TOPICS} patterns of topics, got {len(topics)}")
    for pattern in topics:
        checked(_TOPIC, pattern, "topic", "a ROS topic or a stream, * for any characters")


def _within(what: str, value: float, low: float, high: float, unit: str) -> None:
    if not low <= value <= high:
        raise ContractError(f"{what} must be {low:g} to {high:g} {unit}, got {value:g}")


def _bytes(contents: Mapping[str, Any]) -> int:
    # What is null is removed.
    left = {
        name: {entry: value for entry, value in content.items() if value is not None}
        if isinstance(content, Mapping)
        else content
        for name, content in contents.items()
        if content is not None
    }
    return len(json.dumps(left, separators=(",", ":")))


def _end(content: Any) -> int:
    end = _mapping(content).get("to_us")
    return end if isinstance(end, int) else 0


def _mapping(value: Any) -> Mapping[str, Any]:
    return value if isinstance(value, dict) else {}
