"""The event recorder of one run: it joins the ring, the triggers and the incidents.

| thread | does |
|---|---|
| a source's | puts the message into the ring's queue and, if a trigger needs it, into the triggers' inbox |
| `ring` | writes the segments |
| `recorder` | evaluates the triggers ten times a second, takes events, takes and the shadow's words |
| `incidents` | with low priority: cuts windows that have passed |
| `uploads` | uploads incidents when nothing else is to be uploaded |

Nothing here waits in a thread of the connection, the shadow or the stops: they only leave word.
"""

from __future__ import annotations

import logging
import os
import struct
import threading
from collections import deque
from pathlib import Path
from typing import Any, Callable, Container, Mapping

from iort_agent.common.state import Connection
from iort_agent.common.threads import Clock, Supervised
from iort_agent.errors import AgentError
from iort_agent.files.folder import Folder
from iort_agent.recorder.account import Losses, Reports
from iort_agent.recorder.config import RecorderConfig
from iort_agent.recorder.incidents import Incidents, Tell
from iort_agent.recorder.plan import Edge, Plan
from iort_agent.recorder.ring import Ring
from iort_agent.recorder.triggers import Triggers
from iort_agent.ros import Graph
from iort_agent.sources import Emit
from iort_contract.limits import ContractError
from iort_contract.messages.recorder import (
    DISCONNECT,
    MAX_WHY,
    SERVICE,
    STOP,
    Wanted,
    decode_take,
)
from iort_contract.topics import ACCEPTED

_log = logging.getLogger(__name__)

_STEP_S, _SLOW_S = 0.1, 1.0
# A connection that is lost for longer is an event.
DISCONNECT_S = 5.0
# The kernel prefers the lanes to the thread that cuts.
_NICE = 10
_STRINGS = ("std_msgs/String", "std_msgs/msg/String")
_ENCAPSULATION = 4


class Recorder:
    """Made before the uplink starts. `start` and `close` are called once; `want`, `stopped` and `answers` at
    any time, and none of them waits."""

    def __init__(
        self,
        config: RecorderConfig,
        clock: Clock,
        *,
        robot: str,
        run: str,
        reserve: int,
        tell: Tell,
        connection: Callable[[], Connection],
        reports: Reports = (),
        replayed: Callable[[str], bool] = lambda _: False,
        agent: Callable[[], Mapping[str, Any]] = dict,
        graph: Graph | None = None,
        fires: bool = True,
    ) -> None:
        """Without ``fires``, what earlier runs have begun is ended, and nothing else. Raises `AgentError` if
        the folder cannot be used, or as `Ring`."""
        assert config.folder is not None, "load_config names it"
        self._clock, self._connection, self._graph, self._fires = clock, connection, graph, fires
        folder = _made(config.folder)
        self.ring = Ring(config, clock, folder=folder, run=run, reserve=reserve)
        self._plan = Plan(folder)
        self._losses = Losses(reports, self.ring.now_us())
        self.incidents = Incidents(
            robot,
            config,
            self._plan,
            self.ring,
            clock,
            losses=self._losses,
            reserve=reserve,
            tell=tell,
            folder=_made(folder / "incidents"),
            agent=agent,
        )
        self._triggers = Triggers(self._plan, self.ring.now_us, self.incidents.fire, replayed=replayed)
        # Tells that `answers` has changed.
        self.on_answers: Callable[[], object] = lambda: None
        self.answers: Mapping[str, str] = self._triggers.answers()
        self._wanted: Wanted | None = None
        # What is in the shadow, and was followed in this run.
        self._followed: Wanted | None = None
        # Events that wait: which, and why.
        self._events: deque[tuple[str, str]] = deque(maxlen=64)
        # None before the first settings: a stop that outlived the agent is none of now.
        self._stopped: bool | None = None
        self._away = False
        self._stop, self._end = threading.Event(), threading.Event()
        self._threads = [Supervised("recorder", self._run), Supervised("incidents", self._run_incidents)]
        if graph is not None:
            if config.service is not None:
                graph.offer(config.service, self._on_service)
            if config.topic is not None:
                graph.subscribe(config.topic, self._on_topic)

    def around(self, emit: Emit, only: Container[str] = ()) -> Emit:
        """An `Emit` that keeps and evaluates each sample first; ``only`` are streams for the ring alone."""
        return self._triggers.around(self.ring.around(emit, only))

    def uploads(self) -> Folder:
        """The folder of incidents for the uploads; each file is removed once the bucket has it."""
        return Folder(
            self.incidents.folder,
            clock=self._clock,
            settle_s=0.0,
            remove_after_s=0.0,
            on_uploaded=self.incidents.uploaded,
        )

    def start(self) -> None:
        """Begin."""
        self.ring.start()
        self.incidents.tell_again()
        for thread in self._threads:
            thread.start()
        if self._graph is not None:
            self._graph.start()

    def close(self) -> None:
        """Take what has come, and end. What is open is cut by the next run."""
        self._stop.set()
        for thread in self._threads:
            if thread.is_alive():
                thread.join()
        self.ring.close()
        if self._graph is not None:
            self._graph.close()

    def want(self, wanted: Wanted) -> None:
        """Follow the shadow."""
        self._wanted = wanted

    def stopped(self, stopped: bool) -> None:  # noqa: FBT001 - a setting's value
        """Note whether the emergency stop is in force."""
        if stopped and self._stopped is False:
            self._events.append((STOP, "the emergency stop came into force"))
        self._stopped = stopped

    def alarms(self) -> list[str]:
        """What is wrong with it."""
        wrong = {name: answer for name, answer in self.answers.items() if answer != ACCEPTED}
        alarms = [f"recorder: {name}: {answer}" for name, answer in wrong.items()]
        return [*filter(None, (self.ring.alarm, self._plan.alarm, self.incidents.alarm)), *alarms]

    def report(self) -> dict[str, Any]:
        """Its counts, for the status."""
        return {
            **self._triggers.report(),
            **self.incidents.waiting(),
            **{name: count for name, count in self.incidents.counts.items() if count},
            "ring": self.ring.report(),
            "answers": dict(self.answers),
        }

    def _run(self) -> None:
        slow_at = 0.0
        while not self._stop.is_set():
            self.step()
            if (now := self._clock.monotonic()) >= slow_at:
                slow_at = now + _SLOW_S
                self.step_slowly()
            self._clock.wait(self._stop, _STEP_S)
        # What has come until the sources ended.
        self.step(last=True)

    def step(self, *, last: bool = False) -> None:
        """Evaluate what has come; the recorder's thread calls it. ``last``: no samples come any more."""
        if not self._fires:
            return
        self._triggers.step(last=last)
        while self._events:
            on, why = self._events.popleft()
            now_us = self._clock.now_us()
            if not self._triggers.fire(on, Edge("", now_us, why=why), self.ring.now_us()):
                _log.info("recorder: %s, and no trigger is for it", why)

    def step_slowly(self) -> None:
        """Do what is due once a second."""
        if not self._fires:
            return
        self._losses.look(self.ring.now_us())
        self._look_at_connection()
        wanted = self._wanted
        if wanted is not None and wanted != self._followed:
            self._followed = wanted
            self._triggers.desire(wanted.triggers)
            self._take(wanted.takes)
        answers = {**self._triggers.answers(), **self._take_answers()}
        if answers != self.answers:
            self.answers = answers
            self.on_answers()

    def _take(self, takes: Mapping[str, Any]) -> None:
        for take_id, content in takes.items():
            try:
                self.incidents.take(decode_take(take_id, content))
            except ContractError as error:  # noqa: PERF203 - each take has its own answer
                _log.warning("recorder: take %s is refused: %s", take_id, error)
                self.incidents.refuse(take_id, str(error))

    def _take_answers(self) -> dict[str, str]:
        takes = self._followed.takes if self._followed is not None else {}
        with self._plan.lock:
            return {name: self._plan.takes[name] for name in takes if name in self._plan.takes}

    def _look_at_connection(self) -> None:
        status = self._connection()
        away = not status.connected and status.connects > 0 and status.since_s > DISCONNECT_S
        if away and not self._away:
            # The edge is when it was lost.
            ago_us = round(status.since_s * 1e6)
            edge = Edge("", self._clock.now_us() - ago_us, why="the connection was lost")
            self._triggers.fire(DISCONNECT, edge, self.ring.now_us() - ago_us)
        self._away = away

    def _run_incidents(self) -> None:
        try:
            os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), _NICE)
        except (AttributeError, OSError):
            _log.debug("recorder: this system cannot set the priority of a thread")
        while not self._stop.is_set():
            if not self.incidents.step(self._stop):
                self._clock.wait(self._stop, _SLOW_S / 2)

    def _on_service(self) -> tuple[bool, str]:
        names = self._triggers.names(SERVICE)
        if not names:
            return False, "no trigger is for the service: iort recorder add NAME --on service"
        self._events.append((SERVICE, "called by a program on the robot"))
        return True, f"kept by {', '.join(names)}"

    def _on_topic(self, header: Mapping[str, str], data: bytes) -> None:
        said = _text(data) if header.get("type") in _STRINGS else ""
        self._events.append((SERVICE, said or "published by a program on the robot"))


def _text(data: bytes) -> str:
    """The text of a std_msgs/String, of ROS 1 or 2; empty if it is none."""
    for at in (0, _ENCAPSULATION):
        if len(data) >= at + 4:
            (length,) = struct.unpack_from("<I", data, at)
            if at + 4 + length <= len(data) <= at + 4 + length + 3:
                return data[at + 4 : at + 4 + length].rstrip(b"\0").decode(errors="replace")[:MAX_WHY]
    return ""


def _made(folder: Path) -> Path:
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    except OSError as error:
        raise AgentError(f"recorder: {folder}: {error.strerror or error}") from error
    return folder
