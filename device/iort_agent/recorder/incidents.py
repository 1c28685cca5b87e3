"""The incidents: from an edge to the file in the bucket. `plan` draws their states.

An edge may come from any thread. Windows that overlap are one incident as long as it is not cut. A thread of
low priority cuts each once its window has passed, and the uploads, which take these files last, tell when the
bucket has one. Each change is in the plan before it is told, and told again after a restart unless the queue
on disk has it for certain.
"""

from __future__ import annotations

import logging
import os
import threading
from contextlib import suppress
from pathlib import Path
from typing import Any, Callable, Mapping, Protocol

from iort_agent.common.threads import Clock
from iort_agent.recorder import cut
from iort_agent.recorder.account import Losses
from iort_agent.recorder.config import RecorderConfig
from iort_agent.recorder.plan import OPEN, Edge, Incident, Plan
from iort_contract.catalog.streams import INCIDENT_STREAM
from iort_contract.limits import Value
from iort_contract.messages.files import File, file_key
from iort_contract.messages.recorder import (
    KEPT,
    LOST,
    MAX_AFTER_S,
    NOTIFIED,
    OVER_BUDGET,
    STATES,
    TAKE,
    UPLOADED,
    Take,
    Trigger,
    incident_id,
)
from iort_contract.topics import ACCEPTED
from iort_contract.triggers import cools

_log = logging.getLogger(__name__)

# Takes a sample of the stream of incidents.
Tell = Callable[[str, int, Mapping[str, Value]], object]

# The ring closes its chunks once a second, and messages may be late.
SETTLE_US = 1_500_000
# A batch that is open gets into the queue within a second.
_TOLD_S = 2.0
_RETRY_S, _MAX_RETRY_S, _FLUSH_S, _GIVE_UP_FLUSH_US = 2.0, 60.0, 2.0, 30_000_000
# What waits to be cut or uploaded; each is small in the plan, and the files are bounded in bytes.
_MAX_INCIDENTS = 200
_PAUSE_S, _EMPTY_LOOK_S = 0.002, 0.05
# A take that ends later would wait for ever where a clock is wrong.
_MAX_AHEAD_US = round(MAX_AFTER_S * 1e6)


class Ring(cut.Source, Protocol):
    """What the incidents need of `iort_agent.recorder.ring.Ring`."""

    def now_us(self) -> int: ...
    def ring_us(self, wall_us: int) -> int: ...
    def flush(self, timeout_s: float) -> bool: ...


class StoppedError(Exception):
    """The agent ends; the next run cuts the incident."""


class Incidents:
    """All incidents of a robot. ``agent`` tells the agent's state at an edge; ``reserve`` are the bytes of
    the disk that belong to the queue. Safe to use from several threads; `step` is for one."""

    def __init__(
        self,
        robot: str,
        config: RecorderConfig,
        plan: Plan,
        ring: Ring,
        clock: Clock,
        *,
        losses: Losses,
        reserve: int = 0,
        tell: Tell,
        folder: Path,
        agent: Callable[[], Mapping[str, Any]] = dict,
    ) -> None:
        self._robot, self._config, self._plan, self._ring, self._clock = robot, config, plan, ring, clock
        self._losses, self._tell, self._agent = losses, tell, agent
        self.folder = folder
        self._max_bytes = round(config.max_mb * 1e6)
        # The ring gives way to an incident, and neither takes all of what belongs to the queue.
        self._keep_free = round(max(config.keep_free_mb * 1e6, reserve) / 2)
        # Called after a new file.
        self.on_file: Callable[[], object] = lambda: None
        # Id -> the state that was told, and when.
        self._told: dict[str, tuple[str, float]] = {}
        # Id -> when it is tried again, and how often it failed.
        self._held: dict[str, tuple[float, int]] = {}
        # Trigger -> the ring's time of its last edge in this run that counted.
        self._last_ring_us: dict[str, int] = {}
        self.alarm: str | None = None
        self.counts = dict.fromkeys(("edges", "cooled", "merged", *STATES), 0)
        for part in folder.glob(f"*{cut.PART}"):
            part.unlink(missing_ok=True)
        with plan.lock:
            plan.forget_cuts(ring.now_us())

    def tell_again(self) -> None:
        """Tell what the run before may not have told."""
        with self._plan.lock:
            for incident in self._plan.incidents.values():
                if incident.told != incident.telling:
                    self._say(incident)

    def fire(self, trigger: Trigger, edge: Edge, ring_us: int) -> None:
        """Take an edge of a trigger."""
        plan, name = self._plan, trigger.name
        with plan.lock:
            self.counts["edges"] += 1
            last_us = plan.last_us.get(name)
            # Where times go back, and perhaps forth again, the ring's time counts.
            back = last_us is not None and edge.t_us < last_us
            times = (self._last_ring_us.get(name), ring_us) if back else (last_us, edge.t_us)
            if cools(*times, trigger.cooldown_us):
                self.counts["cooled"] += 1
                return
            plan.last_us[name], self._last_ring_us[name] = edge.t_us, ring_us
            incident = Incident(
                id=incident_id(self._robot, name, edge.t_us),
                from_us=edge.t_us - trigger.before_us,
                to_us=edge.t_us + trigger.after_us,
                ring_from_us=ring_us - trigger.before_us,
                ring_to_us=ring_us + trigger.after_us,
                edges=[edge],
                topics=list(trigger.topics),
                budgets={name: round(trigger.budget_mb_day * 1e6)} if trigger.budget_mb_day else {},
            )
            if trigger.notify:
                incident.state = NOTIFIED
            elif (left := self._plan.left(incident, self._clock.now_us())) is not None and left <= 0:
                incident.state = OVER_BUDGET
                incident.why = f"{name} has spent its {trigger.budget_mb_day:g} MB of the day"
            self._add(incident)

    def take(self, take: Take) -> None:
        """Keep what an operator asks for, also of the past."""
        edge = Edge("", take.to_us, "", {}, take.why, take.by)
        with self._plan.lock:
            if take.id in self._plan.takes:
                return
            if (ahead_us := take.to_us - self._clock.now_us()) > _MAX_AHEAD_US:
                self.refuse(take.id, f"ends {ahead_us / 1e6:.0f} s from now, by the clock of the robot")
                return
            self._plan.answer(take.id, ACCEPTED)
            self._add(
                Incident(
                    id=incident_id(self._robot, take.id, 0),
                    from_us=take.from_us,
                    to_us=take.to_us,
                    ring_from_us=self._ring.ring_us(take.from_us),
                    ring_to_us=self._ring.ring_us(take.to_us),
                    edges=[edge],
                    topics=list(take.topics),
                )
            )

    def refuse(self, take_id: str, why: str) -> None:
        """Note a take that cannot be done."""
        with self._plan.lock:
            if take_id not in self._plan.takes:
                self._plan.answer(take_id, why)
                self._plan.save()

    def step(self, stop: threading.Event) -> bool:
        """Cut the next incident that is due; False if none is. Also ends what has been told for certain."""
        self._plan.retry()
        self._settle()
        incident = self._next()
        if incident is None:
            return False
        try:
            self._cut(incident, stop)
        except StoppedError:
            return False
        except OSError as error:
            self._hold(incident, f"incident {incident.id} cannot be cut: {error.strerror or error}")
        except BaseException:
            self._hold(incident, f"incident {incident.id} cannot be cut")
            raise
        return True

    def uploaded(self, name: Path, key: str) -> None:
        """The bucket has a file, before it is removed here."""
        with self._plan.lock:
            for incident in self._plan.incidents.values():
                if incident.file == name.name and incident.state == KEPT:
                    incident.key = key
                    self._turn(incident, UPLOADED)

    def waiting(self) -> dict[str, int]:
        """How many incidents wait for their window's end, and how many for their upload."""
        with self._plan.lock:
            states = [incident.state for incident in self._plan.incidents.values()]
        return {"open": states.count(OPEN), "waiting": states.count(KEPT)}

    def wait_empty(self, timeout_s: float) -> bool:
        """Wait until no incident waits to be cut or uploaded; whether none does."""
        until, never = self._clock.monotonic() + timeout_s, threading.Event()
        while any(self.waiting().values()):
            if self._clock.monotonic() >= until:
                return False
            # Nobody signals it.
            self._clock.wait(never, _EMPTY_LOOK_S)
        return True

    def _add(self, incident: Incident) -> None:
        """Note a new incident, or add its edge to one whose window it overlaps."""
        plan = self._plan
        if incident.id in plan.incidents:
            return
        other = plan.overlapping(incident) if incident.state == OPEN else None
        if other is None and len(plan.incidents) >= _MAX_INCIDENTS:
            incident.state, incident.why = LOST, f"{_MAX_INCIDENTS} incidents wait already"
        if other is not None:
            self.counts["merged"] += 1
            other.merge(incident)
            incident = other
        else:
            incident.agent = dict(self._agent())
            first = incident.edges[0].trigger or TAKE
            incident.file = f"{first}-{incident.id}.mcap" if incident.state == OPEN else ""
            plan.incidents[incident.id] = incident
            if incident.state != OPEN:
                self.counts[incident.state] += 1
        plan.save()
        _log.info("recorder: %s: incident %s, %s", incident.names, incident.id, incident.state)
        self._say(incident)

    def _next(self) -> Incident | None:
        now_us, now = self._ring.now_us(), self._clock.monotonic()
        with self._plan.lock:
            due = [
                incident
                for incident in self._plan.incidents.values()
                if incident.state == OPEN
                and incident.ring_to_us + SETTLE_US <= now_us
                and self._held.get(incident.id, (0.0, 0))[0] <= now
            ]
        return min(due, key=lambda incident: incident.ring_to_us, default=None)

    def _cut(self, incident: Incident, stop: threading.Event) -> None:
        path = self.folder / incident.file
        with self._plan.lock:
            if incident.ring_to_us + SETTLE_US > self._ring.now_us():
                return  # another window was merged into it just now
            # From here on none is.
            done = bool(incident.key) and path.exists()
            if not done:
                self._plan.follow(incident)
            incident.key = incident.key or "cutting"
            left = self._plan.left(incident, self._clock.now_us())
            free = self._max_bytes - self._waiting_bytes()
        if not done:
            in_time = self._ring.now_us() < incident.ring_to_us + SETTLE_US + _GIVE_UP_FLUSH_US
            if not self._ring.flush(_FLUSH_S) and in_time:
                raise OSError("the ring waits for the disk")
            limit = min(free, free if left is None else left)
            try:
                made = cut.cut(
                    self._ring,
                    incident,
                    path,
                    compression=self._config.compression,
                    limit=limit,
                    losses=self._losses,
                    pause=lambda: self._pause(stop),
                    has_room=self._check_room,
                )
            except cut.TooLargeError:
                self._drop(incident, path, limit, left)
                return
            if not made.messages:
                _remove(path)
                self._end(incident, LOST, "the ring has no message of it any more" + _late(made))
                return
            self._note(incident, made)
            path.with_name(path.name + cut.PART).replace(path)
            with suppress(OSError):
                _sync(self.folder)
        with self._plan.lock:
            self._plan.spend(incident, self._clock.now_us())
            self._plan.note_cut(incident)
            self._held.pop(incident.id, None)
            self.alarm = None
            self._turn(incident, KEPT)
        self.on_file()

    def _note(self, incident: Incident, made: cut.Cut) -> None:
        """Note what the file is before it has its name: after a restart it is not made again."""
        moment_us = max(0, incident.edges[0].t_us)
        file = File(incident.file, "recording", "application/x-mcap", made.size, made.sha256, moment_us)
        with self._plan.lock:
            incident.key = file_key(self._robot, file)
            incident.size, incident.messages, incident.missing = made.size, made.messages, made.missing
            follows = f"follows {incident.follows}" if incident.follows else ""
            late = f"begins late{_late(made)}" if _late(made) else ""
            incident.why = "; ".join(filter(None, (follows, late)))
            if not self._plan.save():
                raise OSError(self._plan.alarm)

    def _drop(self, incident: Incident, path: Path, limit: int, left: int | None) -> None:
        _remove(path)
        if left is not None and limit == left:
            self._end(incident, OVER_BUDGET, f"larger than the {limit / 1e6:.1f} MB left of the day's budget")
        else:
            waiting = (self._max_bytes - limit) / 1e6
            self._end(incident, LOST, f"no room: {waiting:.0f} MB of incidents wait for their upload")

    def _end(self, incident: Incident, state: str, why: str) -> None:
        with self._plan.lock:
            incident.why, incident.file, incident.key = why, "", ""
            self._held.pop(incident.id, None)
            # Until the next one is kept.
            self.alarm = f"recorder: incident {incident.id} is lost: {why}" if state == LOST else None
            self._turn(incident, state)
        if self.alarm is not None:
            _log.error("%s", self.alarm)

    def _turn(self, incident: Incident, state: str) -> None:
        """Change the state: in the plan, and then for the readers."""
        incident.state = state
        self.counts[state] += 1
        self._plan.save()
        self._say(incident)

    def _hold(self, incident: Incident, why: str) -> None:
        times = self._held.get(incident.id, (0.0, 0))[1]
        wait_s = min(_MAX_RETRY_S, _RETRY_S * 2.0 ** min(times, 10))
        self._held[incident.id] = self._clock.monotonic() + wait_s, times + 1
        self.alarm = f"recorder: {why}; it is tried again"
        _log.log(logging.DEBUG if times else logging.WARNING, "%s", self.alarm)
        _remove(self.folder / incident.file)
        with self._plan.lock:
            # It may be merged with others again.
            incident.key = ""
        if self._ring.since_us() > incident.ring_to_us:
            self._end(incident, LOST, f"the ring has no message of it any more: {why}")

    def _pause(self, stop: threading.Event) -> None:
        if self._clock.wait(stop, _PAUSE_S):
            raise StoppedError

    def _check_room(self) -> None:
        """Raise `OSError` if the disk is so full that the ring and the queue need the rest."""
        status = os.statvfs(self.folder)
        if status.f_bavail * status.f_frsize < self._keep_free:
            raise OSError(f"less than {self._keep_free / 1e6:.0f} MB of the disk are free")

    def _waiting_bytes(self) -> int:
        return sum(incident.size for incident in self._plan.incidents.values() if incident.state == KEPT)

    def _say(self, incident: Incident) -> None:
        """Tell an incident's state as a sample."""
        self._tell(INCIDENT_STREAM, self._clock.now_us(), incident.sample())
        self._told[incident.id] = incident.telling, self._clock.monotonic()

    def _settle(self) -> None:
        """Note what the queue on disk has by now, and forget incidents that have ended."""
        now = self._clock.monotonic()
        with self._plan.lock:
            settled = [known for known, (_, at) in self._told.items() if now - at >= _TOLD_S]
            for known in settled:
                telling, _ = self._told.pop(known)
                incident = self._plan.incidents.get(known)
                if incident is None:
                    continue
                incident.told = telling
                if incident.state not in (OPEN, KEPT) and telling == incident.telling:
                    del self._plan.incidents[known]
            if settled:
                self._plan.save()


def _late(made: cut.Cut) -> str:
    late_s = made.late_us / 1e6
    return f": the ring begins {late_s:.1f} s after the window" if late_s > 1 else ""


def _remove(path: Path) -> None:
    with suppress(OSError):
        path.with_name(path.name + cut.PART).unlink(missing_ok=True)


def _sync(folder: Path) -> None:
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
