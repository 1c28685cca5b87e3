"""When a trigger of the event recorder fires: its language, and the one evaluator of car and dry-run.

The language is that of `iort_contract.expression` with ``delta(field, 1s)``, the change since the newest
sample that is at least a second older; ``silent(stream, 1s)``, true when the stream's last sample is a second
old; and, at the end, ``for 2s``. A trigger fires at an edge: the moment when its condition becomes true, or
has been true for that long.

The samples alone decide, by their own times: no clock, nor the order in which they come, as long as none is
more than `SETTLE_US` late. Between samples a field keeps its value.
"""

from __future__ import annotations

import ast
import heapq
import math
import re
from collections import deque
from typing import Any, Callable, Iterable, Mapping, NamedTuple

from iort_contract import expression
from iort_contract.catalog.derived import DERIVED, PARAMETERS, SOURCES, Vehicle, calculator
from iort_contract.catalog.streams import OWN_STREAMS
from iort_contract.expression import FIELD, ExpressionError, MismatchError, Node, Reader
from iort_contract.limits import ContractError, Value
from iort_contract.messages.recorder import FAULT, MAX_SPAN_S, Trigger, check_limits
from iort_contract.topics import check_stream

# A sample is evaluated when one that is this much newer has come, so that streams' samples are in order.
SETTLE_US = 200_000
# A sample this much older than the newest is no late one: the clock was set back.
_SET_BACK_US = 10_000_000
# Samples that wait for older ones, and those of which a `delta` is: a time that stands still, or a stream of
# many samples, must not fill the memory.
MAX_WAITING, MAX_HISTORY = 10_000, 20_000
# Calls of `delta` and `silent` in a condition.
MAX_AGED = 4
_MAX_DELTA_US, _MAX_SPAN_US = 60_000_000, 3_600_000_000
_FAULT_WHEN = "fault_code"
_UNITS = {"ms": 1_000, "s": 1_000_000, "m": 60_000_000, "min": 60_000_000, "h": 3_600_000_000}
_DURATION = r"(\d+(?:\.\d+)?)\s?(ms|s|min|m|h)\b"
_FOR = re.compile(r"\sfor\s+(\S.*)$")
_TEXT = r"'(?:\\.|[^'\\])*'" + r'|"(?:\\.|[^"\\])*"'
_TEXT_OR_DURATION = re.compile(_TEXT + r"|(?<![\w.])(?P<duration>\d+(?:\.\d+)?(?:ms|s|min|m|h)\b)")


class Rule(NamedTuple):
    """A parsed condition.

    In its tree, ``delta(...)`` and ``silent(...)`` are fields of these names. ``fields`` has the plain
    fields; ``deltas`` a name's field and age, ``silences`` a name's stream and age, in microseconds.
    """

    text: str
    condition: Node
    fields: tuple[str, ...]
    deltas: Mapping[str, tuple[str, int]]
    silences: Mapping[str, tuple[str, int]]
    for_us: int = 0


class Edge(NamedTuple):
    """The moment when a trigger fires, and the values of its fields then."""

    t_us: int
    values: Mapping[str, Value]


class Window(NamedTuple):
    """What is kept: from before the first of these edges until after the last."""

    from_us: int
    to_us: int
    edges: tuple[Edge, ...]


def parse_trigger(when: str) -> Rule:
    """Parse a trigger's condition; raises `ExpressionError`, which shows the place."""
    text = expression.one_line(when)
    condition, for_us = text, 0
    # Texts may have the word, too.
    if found := _FOR.search(re.sub(_TEXT, lambda quoted: "_" * len(quoted.group()), text)):
        condition = text[: found.start()].rstrip()
        for_us = _duration_us(found.group(1), text, found.start(1), _MAX_SPAN_US)
    reader = _RuleReader(condition)
    tree = reader.parse()
    aged = reader.deltas.keys() | reader.silences.keys()
    fields = (expression.names(tree) - aged) | {name for name, _ in reader.deltas.values()}
    if len(aged) > MAX_AGED:
        raise ExpressionError(f"at most {MAX_AGED} of delta() and silent() in a condition", text, 0)
    if not fields and not aged:
        raise ExpressionError("a condition without a field is always true or never", text, 0)
    return Rule(text, tree, tuple(sorted(fields)), reader.deltas, reader.silences, for_us)


def rule_of(trigger: Trigger) -> Rule | None:
    """The rule of a trigger with a condition, or of one for fault codes; None if something else fires it.

    Raises `ExpressionError`.
    """
    when = _FAULT_WHEN if trigger.on == FAULT else trigger.when
    return parse_trigger(when) if when else None


def vehicle_of(trigger: Trigger) -> Vehicle | None:
    """The vehicle's parameters that a trigger brings; None if it has none."""
    return Vehicle(trigger.gain, trigger.offset) if trigger.gain else None


def evaluator_of(trigger: Trigger) -> Evaluator | None:
    """The evaluator of a trigger; None if it has no rule. Raises as `check_trigger`."""
    rule = rule_of(trigger)
    return None if rule is None else Evaluator(rule, trigger.stream, vehicle_of(trigger), trigger.others)


def check_trigger(trigger: Trigger) -> Trigger:
    """Return the trigger, if an agent may accept it; raises `ContractError`, or `ExpressionError` for its
    condition. Whether its streams have its fields is known only with samples."""
    check_limits(trigger)
    evaluator = evaluator_of(trigger)
    if evaluator is not None and (own := evaluator.streams & OWN_STREAMS):
        raise ContractError(f"{min(own)} is the agent's own stream, which fires no trigger")
    return trigger


class Evaluator:
    """Finds the edges of a rule in samples of its streams.

    A field is one of ``stream``, or ``other.field`` of a stream in ``others``. ``streams`` are those that the
    rule needs. ``late`` counts samples that were ignored because newer ones were evaluated already.
    Raises `ContractError` for a derived field whose parameters the ``vehicle`` does not have.
    """

    def __init__(
        self, rule: Rule, stream: str, vehicle: Vehicle | None = None, others: Iterable[str] = ()
    ) -> None:
        self.rule, self._true = rule, expression.compiled(rule.condition)
        self._derived: dict[str, Callable[[Mapping[str, Value]], Value]] = {}
        self.late = 0
        # Stream -> its fields in the rule, each by the name that it has there and the name in the samples.
        self.fields: dict[str, list[tuple[str, str]]] = {}
        others = frozenset(others)
        for name in rule.fields:
            first, _, rest = name.partition(".")
            of, field = (first, rest) if rest and first in others else (stream, name)
            self.fields.setdefault(of, []).append((name, field))
            missing = () if vehicle is not None else PARAMETERS.get(field, ())
            if missing:
                raise ContractError(f"{field} needs the vehicle's parameters {', '.join(missing)}")
            if field in DERIVED:
                self._derived[field] = calculator(field, vehicle)
        silent = frozenset(of for of, _ in rule.silences.values())
        self.streams = frozenset(self.fields) | silent
        if unused := others - self.streams:
            raise ContractError(f"the condition has no field of the stream {min(unused)}")
        self._deltas: dict[str, list[tuple[str, int]]] = {}
        for name, (field, age_us) in rule.deltas.items():
            self._deltas.setdefault(field, []).append((name, age_us))
        # The types of each field's values so far, their kinds, and the error if the condition mixes them.
        self._types: dict[str, set[type]] = {name: set() for name in sorted(expression.names(rule.condition))}
        self._kinds: dict[str, frozenset[str]] = dict.fromkeys(self._types, frozenset())
        self._problem = ""
        self._begin()

    def _begin(self) -> None:
        self._values: dict[str, Value] = {
            **dict.fromkeys((*self._kinds, *self.rule.fields)),
            **dict.fromkeys(self.rule.silences, False),
        }
        self._history: dict[str, deque[tuple[int, Value]]] = {name: deque() for name in self.rule.deltas}
        self._last: dict[str, int] = {}
        # Samples that older ones may still come before: time, order of arrival, stream, values.
        self._waiting: list[tuple[int, int, str, dict[str, Value]]] = []
        self._count = 0
        self._newest = self._evaluated = -(2**62)
        self._since: int | None = None
        self._fired = False

    def sample(self, stream: str, t_us: int, values: Mapping[str, Any]) -> tuple[Edge, ...]:
        """Take a sample; returns the edges that it makes certain.

        Raises `MismatchError` if the condition compares a number with a text, and `ContractError` if a
        ``delta`` is of too many samples.
        """
        if stream not in self.streams:
            return self.advance(t_us)
        edges: tuple[Edge, ...] = ()
        if t_us < self._newest - _SET_BACK_US:
            edges = self.finish()
            self._begin()
        if t_us <= self._evaluated:
            self.late += 1
            return edges
        named = {name: self._value(field, values) for name, field in self.fields.get(stream, ())}
        self._count += 1
        heapq.heappush(self._waiting, (t_us, self._count, stream, named))
        edges += self.advance(t_us)
        if len(self._waiting) > MAX_WAITING:
            edges += self._evaluate_until(self._waiting[0][0])
        return edges

    def advance(self, t_us: int) -> tuple[Edge, ...]:
        """Take note that it is ``t_us``, in the time of the samples; returns the edges that this makes
        certain."""
        if t_us <= self._newest:
            return ()
        self._newest = t_us
        return self._evaluate_until(t_us - SETTLE_US)

    def finish(self) -> tuple[Edge, ...]:
        """Return the edges up to the newest time: no older samples come any more."""
        return self._evaluate_until(self._newest)

    def _evaluate_until(self, until_us: int) -> tuple[Edge, ...]:
        edges: list[Edge] = []
        waiting = self._waiting
        while True:
            sample_us = waiting[0][0] if waiting else math.inf
            t_us = min(sample_us, self._next_deadline())
            if t_us > until_us:
                return tuple(edges)
            while waiting and waiting[0][0] == t_us:
                _, _, stream, named = heapq.heappop(waiting)
                self._take(stream, int(t_us), named)
            if (edge := self._evaluate(int(t_us))) is not None:
                edges.append(edge)

    def _next_deadline(self) -> float:
        """When the condition may change without a sample."""
        pending = self._since is not None and not self._fired
        if not pending and not self.rule.silences:
            return math.inf
        times = [self._last[of] + age_us for of, age_us in self.rule.silences.values() if of in self._last]
        if pending:
            times.append((self._since or 0) + self.rule.for_us)
        return min((t_us for t_us in times if t_us > self._evaluated), default=math.inf)

    def _take(self, stream: str, t_us: int, named: Mapping[str, Value]) -> None:
        self._last[stream] = t_us
        for name, value in named.items():
            self._values[name] = value
            for delta, age_us in self._deltas.get(name, ()):
                self._values[delta] = _change(self._history[delta], t_us, value, age_us)

    def _evaluate(self, t_us: int) -> Edge | None:
        self._evaluated = t_us
        values = self._values
        for name, (of, age_us) in self.rule.silences.items():
            values[name] = of in self._last and t_us - self._last[of] >= age_us
        self._check_kinds()
        if not self._true(values):
            self._since, self._fired = None, False
            return None
        if self._since is None:
            self._since = t_us
        if self._fired or t_us < self._since + self.rule.for_us:
            return None
        self._fired = True
        return Edge(t_us, dict(values))

    def _check_kinds(self) -> None:
        for name, known in self._types.items():
            value = self._values[name]
            if type(value) not in known:
                known.add(type(value))
                self._kinds[name] |= expression.kinds(value)
                self._problem = expression.mismatch(self.rule.condition, self._kinds)
        if self._problem:
            raise MismatchError(self._problem)

    def _value(self, field: str, values: Mapping[str, Any]) -> Value:
        calculated = self._derived.get(field)
        if calculated is not None and all(source in values for source in SOURCES[field]):
            return calculated(values)
        return _plain(values.get(field))


def windows(edges: Iterable[Edge], before_us: int, after_us: int, cooldown_us: int) -> list[Window]:
    """The windows of a trigger's edges, in order of time: without edges in a cooldown, and merged."""
    last_us: int | None = None
    found: list[Window] = []
    for edge in edges:
        if cools(last_us, edge.t_us, cooldown_us):
            continue
        last_us = edge.t_us
        window = Window(edge.t_us - before_us, edge.t_us + after_us, (edge,))
        if found and (merged := merge(found[-1], window)) is not None:
            found[-1] = merged
        else:
            found.append(window)
    return found


def cools(last_us: int | None, t_us: int, cooldown_us: int) -> bool:
    """Whether an edge is ignored, since the trigger's last one that was not is within the cooldown."""
    return last_us is not None and 0 <= t_us - last_us < cooldown_us


def merge(one: Window, other: Window) -> Window | None:
    """Two windows as one, also of different triggers; None if they do not overlap, or are too long
    together."""
    from_us, to_us = min(one.from_us, other.from_us), max(one.to_us, other.to_us)
    apart = one.to_us < other.from_us or other.to_us < one.from_us
    if apart or to_us - from_us > MAX_SPAN_S * 1_000_000:
        return None
    return Window(from_us, to_us, tuple(sorted(one.edges + other.edges, key=lambda edge: edge.t_us)))


def _change(history: deque[tuple[int, Value]], t_us: int, value: Value, age_us: int) -> Value:
    """The value minus the newest one that is old enough; a text's is the text itself, for the check of
    kinds."""
    if isinstance(value, str):
        return value
    if len(history) >= MAX_HISTORY:
        raise ContractError(
            f"a delta of {age_us / 1_000_000:g} s is of more than {MAX_HISTORY} samples: choose a shorter one"
        )
    history.append((t_us, value))
    while len(history) > 1 and history[1][0] <= t_us - age_us:
        history.popleft()
    old = history[0][1] if history[0][0] <= t_us - age_us else None
    return None if value is None or old is None else _plain(float(value) - float(old))


def _plain(value: Any) -> Value:
    """A value as it is recorded: a number that is not finite is null."""
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return value if isinstance(value, (bool, int, str)) else None


def _duration_us(said: str, text: str, position: int, most_us: int) -> int:
    found = re.fullmatch(_DURATION, said.strip())
    if not found:
        raise ExpressionError("a duration is a number with ms, s, min or h, such as 2s", text, position)
    duration_us = round(float(found.group(1)) * _UNITS[found.group(2)])
    if not 0 < duration_us <= most_us:
        raise ExpressionError(f"must be more than 0 and at most {most_us // 1_000_000} s", text, position)
    return duration_us


class _RuleReader(Reader):
    """Reads the language with ``delta`` and ``silent``.

    Python has no durations: each is a name of its length to Python.
    """

    functions = "the only functions are abs(x), delta(field, 1s) and silent(stream, 1s)"

    def __init__(self, text: str) -> None:
        self._durations: dict[int, str] = {}
        self.deltas: dict[str, tuple[str, int]] = {}
        self.silences: dict[str, tuple[str, int]] = {}
        super().__init__(text, _TEXT_OR_DURATION.sub(self._named, text))

    def _named(self, found: re.Match[str]) -> str:
        duration = found.group("duration")
        if duration is None:
            return found.group()
        self._durations[found.start()] = duration
        return "_" * len(duration)

    def field(self, node: ast.expr) -> Node:
        if self.position(node) in self._durations and isinstance(node, ast.Name):
            raise self.error("a duration belongs in delta(), in silent() or after for", node)
        return super().field(node)

    def call(self, node: ast.Call) -> Node:
        name = node.func.id if isinstance(node.func, ast.Name) else ""
        if name not in ("delta", "silent"):
            return super().call(node)
        what = "field" if name == "delta" else "stream"
        if len(node.args) != 2 or node.keywords:
            raise self.error(f"{name} needs a {what} and a duration: {name}({what}, 1s)", node)
        of, age = node.args
        position = self.position(age)
        most_us = _MAX_DELTA_US if name == "delta" else _MAX_SPAN_US
        said = self._durations.get(position, "") if isinstance(age, ast.Name) else ""
        age_us = _duration_us(said, self.text, position, most_us)
        if name == "silent":
            stream = self._stream(of)
            return self._aged(self.silences, f"silent({stream}, {said})", stream, age_us)
        if not isinstance(of, (ast.Name, ast.Attribute, ast.Subscript)):
            raise self.error("delta is of a field", of)
        field = str(self.field(of).value)
        return self._aged(self.deltas, f"delta({field}, {said})", field, age_us)

    def _aged(self, into: dict[str, tuple[str, int]], name: str, of: str, age_us: int) -> Node:
        into[name] = (of, age_us)
        return Node(FIELD, value=name)

    def _stream(self, node: ast.expr) -> str:
        # A stream's name may have dashes.
        said = str(node.value) if isinstance(node, ast.Constant) else self.said(node)
        try:
            return check_stream(said)
        except ContractError as error:
            raise self.error(str(error), node) from error
