"""The triggers in force: they come from the shadow, hold offline and after a restart, and are evaluated on
the samples in the recorder's own thread.

A source's thread only puts a sample of a stream that a trigger needs into a bounded inbox. Each trigger's
processor time is measured; one that takes too much is refused, and the shadow says so.

```
 desired ──► wrong ─────────────► why not
        └──► armed ─────────────► accepted
               ├─ costs too much, or compares a number with a text ──► why not, until it is changed
               └─ its stream or field does not come ──► why it cannot fire, until it comes
```
"""

from __future__ import annotations

import logging
import time
from collections import deque
from typing import Any, Callable, Mapping, Tuple

from iort_agent.common.schema import did_you_mean
from iort_agent.recorder.plan import MAX_TEXT, Edge, Plan
from iort_agent.sources import Emit
from iort_agent.sources.intake import Selected
from iort_contract.catalog.derived import DERIVED, SOURCES
from iort_contract.catalog.streams import TYPES_STREAM
from iort_contract.expression import ExpressionError, MismatchError
from iort_contract.limits import ContractError, Value
from iort_contract.messages.recorder import MAX_TRIGGERS, Trigger, decode_trigger
from iort_contract.ros.message import RosMessage
from iort_contract.topics import ACCEPTED
from iort_contract.triggers import Edge as TriggerEdge
from iort_contract.triggers import check_trigger, evaluator_of

_log = logging.getLogger(__name__)

# Samples and bytes that wait to be evaluated.
_MAX_INBOX, _MAX_INBOX_BYTES = 20_000, 32_000_000
# The most of a core that one trigger may take, over so long, and the most at once.
MAX_SHARE, _MEASURED_US, _MAX_AT_ONCE_NS = 0.05, 10_000_000, 500_000_000
_LOOK_AT_COST = 64
# Silence is noticed so long after it began, for samples that are late.
_LATE_US = 1_000_000
# A stream or a field that has not come for so long, or in so many samples, may never come.
_ABSENT_US, _ABSENT_SAMPLES = 10_000_000, 10
_HOUR_US = 3_600_000_000

# Takes a trigger, its edge, and the time of the edge in the ring's time.
OnEdge = Callable[[Trigger, Edge, int], None]


# A sample: its stream and time, the ring's time, and its values.
_Heard = Tuple[str, int, int, Mapping[str, Value]]


class _Armed:
    """A trigger and its evaluator; ``problem`` says why it is refused."""

    def __init__(self, trigger: Trigger, now_us: int) -> None:
        self.trigger, self.armed_us = trigger, now_us
        self.evaluator = evaluator_of(trigger)
        self.problem = ""
        # What has not come yet: the streams, and each stream's fields.
        self.streams = set(self.evaluator.streams) if self.evaluator is not None else set()
        fields = self.evaluator.fields if self.evaluator is not None else {}
        self._absent = {stream: {field for _, field in names} for stream, names in fields.items()}
        self._other: dict[str, list[str]] = {}
        self._seen: dict[str, int] = {}
        # The newest sample's own time, and when it came.
        self._newest = (0, 0)
        self._first_us: int | None = None
        # Since the last look at the cost, and in all.
        self._busy_ns, self._since_us = 0, now_us
        self.busy_ns = self.samples = 0

    def take(
        self, batch: list[_Heard], now_us: int, *, played_us: int | None, last: bool
    ) -> list[tuple[Edge, int]]:
        """Evaluate the samples; the edges, with their times in the ring. Raises what the evaluator does.

        ``played_us`` is the newest time in a recording that is played, None of what is heard now; ``last``:
        no samples come any more.
        """
        evaluator, found = self.evaluator, []
        if evaluator is None or self.problem:
            return []
        began, streams = time.thread_time_ns(), evaluator.streams
        for i, (stream, t_us, heard_us, sample) in enumerate(batch):
            if stream in streams:
                self.samples += 1
                self._note(stream, t_us, heard_us, sample)
                for edge_us, values in evaluator.sample(stream, t_us, sample):
                    found.append((self._edge(edge_us, values), _ring_us(heard_us, t_us, edge_us)))
            if not i % _LOOK_AT_COST and time.thread_time_ns() - began > _MAX_AT_ONCE_NS:
                break
        t_us, at_us = self._newest
        # The time that it is now, in the samples' time and in the ring's.
        if not at_us:
            horizon_us, horizon_at_us = 0, now_us
        elif played_us is not None:
            horizon_us, horizon_at_us = played_us, now_us
        else:
            horizon_us, horizon_at_us = t_us + now_us - at_us - _LATE_US, now_us - _LATE_US
        late: tuple[TriggerEdge, ...] = ()
        if horizon_us > t_us:
            late = evaluator.advance(horizon_us)
        else:
            horizon_us, horizon_at_us = t_us, at_us
        for edge_us, values in (*late, *(evaluator.finish() if last else ())):
            found.append((self._edge(edge_us, values), _ring_us(horizon_at_us, horizon_us, edge_us)))
        self._measure(time.thread_time_ns() - began, now_us, played=played_us is not None)
        return found

    def answer(self, now_us: int) -> str:
        """`ACCEPTED`, or why it does not fire."""
        if self.problem:
            return self.problem
        if self.streams and now_us - self.armed_us > _ABSENT_US:
            return f"no sample of the stream {min(self.streams)} since it was added"
        for stream, fields in self._absent.items():
            if fields and self._seen.get(stream, 0) >= _ABSENT_SAMPLES:
                field = min(fields)
                return f"the stream {stream} has no field {field}{did_you_mean(field, self._other[stream])}"
        return ACCEPTED

    def cost_us(self) -> float:
        """Microseconds of a core for a sample."""
        return round(self.busy_ns / 1000 / max(1, self.samples), 2)

    def _note(self, stream: str, t_us: int, ring_us: int, values: Mapping[str, Value]) -> None:
        self._newest = (t_us, ring_us)
        if self._first_us is None:
            self._first_us = t_us
        absent = self._absent.get(stream)
        if absent:
            for field in [*absent]:
                if field in values or (field in DERIVED and all(one in values for one in SOURCES[field])):
                    absent.discard(field)
            self._seen[stream] = self._seen.get(stream, 0) + 1
            if self._seen[stream] == _ABSENT_SAMPLES and absent:
                self._other[stream] = list(values)
        self.streams.discard(stream)

    def _edge(self, t_us: int, values: Mapping[str, Value]) -> Edge:
        # The plan on disk has them, and is written for each edge.
        short = {name: of[:MAX_TEXT] if isinstance(of, str) else of for name, of in values.items()}
        return Edge(self.trigger.name, t_us, self.trigger.when or self.trigger.on, short)

    def _measure(self, busy_ns: int, now_us: int, *, played: bool) -> None:
        self.busy_ns += busy_ns
        self._busy_ns += busy_ns
        # A recording may be played faster than time passes.
        first_us = self._newest[0] if self._first_us is None else self._first_us
        passed_us = max(now_us - self._since_us, self._newest[0] - first_us if played else 0)
        if busy_ns <= _MAX_AT_ONCE_NS and passed_us < _MEASURED_US:
            return
        share = self._busy_ns / 1000 / max(1, passed_us)
        if busy_ns > _MAX_AT_ONCE_NS or share > MAX_SHARE:
            self.problem = (
                f"costs too much: {share:.0%} of a core, {self.cost_us():.0f} us a sample; "
                f"at most {MAX_SHARE:.0%}"
            )
            _log.error("recorder: trigger %s %s", self.trigger.name, self.problem)
        self._busy_ns, self._since_us, self._first_us = 0, now_us, None


def _ring_us(heard_us: int, t_us: int, edge_us: int) -> int:
    """The time of an edge in the ring, by a sample that came at ``heard_us`` and is of ``t_us``."""
    ago_us = t_us - edge_us
    return heard_us - ago_us if 0 <= ago_us < _HOUR_US else heard_us


class Triggers:
    """All triggers. `around` is for the sources' threads, `desire` for any; the recorder's thread calls
    `step`, `fire` and `answers`."""

    def __init__(
        self,
        plan: Plan,
        now_us: Callable[[], int],
        on_edge: OnEdge,
        *,
        replayed: Callable[[str], bool] = lambda _: False,
    ) -> None:
        self._plan, self._now_us, self._on_edge, self._replayed = plan, now_us, on_edge, replayed
        self._inbox: deque[_Heard] = deque()
        self._bytes = 0
        # The newest time of any stream.
        self._newest_us = 0
        self._armed: dict[str, _Armed] = {}
        self._refused: dict[str, str] = {}
        # The streams that are evaluated.
        self._streams: frozenset[str] = frozenset()
        # Samples that came faster than they could be evaluated.
        self.unseen = 0
        self._arm()

    def around(self, emit: Emit) -> Emit:
        """An `Emit` that takes note of each sample that a trigger needs."""
        note = self.note

        def emit_noted(stream: str, t_us: int, values: Mapping[str, Value], *, more: bool = False) -> float:
            note(stream, t_us, values)
            return emit(stream, t_us, values, more=more)

        return emit_noted

    def note(self, stream: str, t_us: int, values: Mapping[str, Value]) -> None:
        """Put a sample into the inbox if a trigger needs it."""
        if stream in self._streams:
            if type(values) is Selected and values.again:
                return
            if len(self._inbox) >= _MAX_INBOX or self._bytes > _MAX_INBOX_BYTES:
                self.unseen += 1
                return
            # Not exact, since several threads count; `step` begins anew. `isinstance` would take longer.
            if type(values) is RosMessage:
                self._bytes += len(values.raw)
            self._inbox.append((stream, t_us, self._now_us(), values))
        # After the inbox has it.
        self._newest_us = max(self._newest_us, t_us)

    def desire(self, triggers: Mapping[str, Any]) -> None:
        """Put these in force instead of the others, also after a restart."""
        with self._plan.lock:
            if triggers == self._plan.triggers:
                return
            self._plan.triggers = dict(triggers)
            self._plan.last_us = {n: at for n, at in self._plan.last_us.items() if n in triggers}
            self._plan.save()
        self._arm()

    def step(self, *, last: bool = False) -> None:
        """Evaluate what has come; ``last`` if no samples come any more."""
        newest_us = self._newest_us
        batch = [self._inbox.popleft() for _ in range(len(self._inbox))]
        self._bytes = 0
        now_us = self._now_us()
        for armed in [*self._armed.values()]:
            try:
                replayed = armed.evaluator is not None and any(map(self._replayed, armed.evaluator.streams))
                edges = armed.take(batch, now_us, played_us=newest_us if replayed else None, last=last)
            except (ContractError, MismatchError) as error:
                armed.problem = str(error)
                _log.error("recorder: trigger %s: %s", armed.trigger.name, error)
                continue
            except Exception as error:  # noqa: BLE001 - whatever it is, the other triggers must fire
                armed.problem = f"failed: {type(error).__name__}: {error}"
                _log.exception("recorder: trigger %s", armed.trigger.name)
                continue
            for edge, ring_us in edges:
                self._on_edge(armed.trigger, edge, ring_us)

    def fire(self, on: str, edge: Edge, ring_us: int) -> int:
        """Fire the triggers of an event; how many there are."""
        fired = [armed.trigger for armed in [*self._armed.values()] if armed.trigger.on == on]
        for trigger in fired:
            self._on_edge(trigger, Edge(trigger.name, edge.t_us, on, edge.values, edge.why, edge.by), ring_us)
        return len(fired)

    def names(self, on: str) -> list[str]:
        """The triggers of an event."""
        return [name for name, armed in [*self._armed.items()] if armed.trigger.on == on]

    def answers(self) -> dict[str, str]:
        """By name: `ACCEPTED`, or why not."""
        now_us = self._now_us()
        return {
            **{name: armed.answer(now_us) for name, armed in [*self._armed.items()]},
            **self._refused,
        }

    def report(self) -> dict[str, Any]:
        """What each trigger has cost, in microseconds of a core for a sample."""
        costs = {name: armed.cost_us() for name, armed in [*self._armed.items()] if armed.samples}
        return {"triggers": len(self._armed), "cost_us": costs, "unseen": self.unseen}

    def _arm(self) -> None:
        now_us, before = self._now_us(), self._armed
        with self._plan.lock:
            wanted = dict(sorted(self._plan.triggers.items()))
        armed: dict[str, _Armed] = {}
        refused: dict[str, str] = {}
        for name, content in wanted.items():
            try:
                trigger = check_trigger(decode_trigger(name, content))
                if len(armed) >= MAX_TRIGGERS:
                    raise ContractError(f"at most {MAX_TRIGGERS} triggers")  # noqa: TRY301 - one way out
                known = before.get(name)
                one = known if known is not None and known.trigger == trigger else _Armed(trigger, now_us)
                armed[name] = one
            except (ContractError, ExpressionError) as error:  # noqa: PERF203 - each has its own answer
                refused[name] = str(error).partition("\n")[0]
                _log.warning("recorder: trigger %s is refused: %s", name, error)
        self._armed, self._refused = armed, refused
        needed = [one.evaluator.streams for one in armed.values() if one.evaluator is not None]
        self._streams = frozenset().union(*needed) - {TYPES_STREAM}
