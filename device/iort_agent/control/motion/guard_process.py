"""The guard's process: `iort_agent.control.motion.guard` starts it and explains it.

Its input is lines of JSON: first the name of the agent's node and the stops; then a motion's topic, the end
of its lease by the machine's monotonic clock, or null, and whether an emergency stop holds. It answers each
line with a byte, and begins once it is in the ROS graph. The end of the input is the agent's end. In an
emergency stop the guard lives on until the agent's node is in the graph again, or until somebody ends it.
"""

from __future__ import annotations

import json
import logging
import os
import select
import signal
import sys
import threading
from contextlib import suppress
from pathlib import Path
from typing import Any, Mapping

from iort_agent.clock import SystemClock
from iort_agent.common.threads import Supervised
from iort_agent.control.motion.kept_stop import KeptStop
from iort_agent.control.motion.stops import Stops
from iort_agent.ros1.json_message import encode
from iort_agent.ros1.node import Node, shared

_log = logging.getLogger("iort_agent.guard")
# The stop of a lease that the agent has certainly not ended.
_UNANSWERED = 2
# In an emergency stop the agent writes at least every `STOP_HOLD_S`.
_SILENT_S = 0.15
_POLL_S, _IDLE_S = 0.05, 4.0
# Between two looks for the agent's node. It must be there several times in a row: subscribers need a moment
# to connect to it, and it may die again.
_LOOK_S, _LOOKS = 1.0, 3
_CONNECT_S = 2.0
_BUFFER = 65_536
_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


class _Motion:
    """One motion's stop, and when it is due."""

    def __init__(self, node: Node, topic: str, config: Mapping[str, Any]) -> None:
        self.stops = Stops()
        self._node, self._topic, self._stop = node, topic, config["stop"]
        self._definition = node.definition(config["type"])
        node.advertise(topic, config["type"])

    def heard(self) -> bool:
        return self._node.listeners(self._topic) > 0

    def tick(self, now: float, now_us: int) -> bool:
        if not self.stops.stop_due(now):
            return False
        self._node.publish(self._topic, encode(self._definition, self._stop, now_us=now_us, partial=True))
        return True


class _Guard:
    def __init__(self, config: Mapping[str, Any]) -> None:
        self._agent: str = config["agent"]
        self.node, self._clock = shared(f"{self._agent}_guard"), SystemClock()
        self._motions = {topic: _Motion(self.node, topic, one) for topic, one in config["stops"].items()}
        # Stops since the last news of a lease. At its end the agent publishes a stop itself, and tells it.
        self._stops = 0
        self._joined: float | None = None
        self._queue: str | None = config.get("queue")

    def ready(self) -> bool:
        """Whether the stops would be heard: the topics' subscribers have connected, or had the time to."""
        if not self.node.ready.is_set():
            return False
        now = self._clock.monotonic()
        self._joined = now if self._joined is None else self._joined
        return all(map(_Motion.heard, self._motions.values())) or now - self._joined > _CONNECT_S

    def heard(self) -> None:
        """Leave the stops of an emergency stop to the agent: it lives."""
        for motion in self._motions.values():
            motion.stops.put_off(self._clock.monotonic() + _SILENT_S)

    def take(self, line: bytes) -> None:
        """Take what is known of a motion; an empty line only asks for an answer."""
        if not line.strip():
            return
        topic, until, held = json.loads(line)
        motion = self._motions[topic]
        if not held and (until is None or motion.stops.held):
            motion.stops = Stops()
        if held:
            motion.stops.hold(self._clock.monotonic())
        elif until is not None:
            motion.stops.move(until)
        self._stops = 0

    def agent_gone(self) -> None:
        """End every lease now, and go on with an emergency stop."""
        now = self._clock.monotonic()
        for motion in self._motions.values():
            motion.stops.cut(now)
            motion.stops.put_off(now)

    def watch(self, over: threading.Event) -> None:
        """Keep an emergency stop for the next agent, and set ``over`` once its node is in the graph."""
        if self._queue is not None and any(motion.stops.held for motion in self._motions.values()):
            # The agent may have died before it did. A slow disk delays no stop here.
            KeptStop(Path(self._queue)).keep(stopped=True)
        seen = 0
        while not over.wait(_LOOK_S):
            seen = seen + 1 if self.node.lives(self._agent) else 0
            if seen == _LOOKS:
                over.set()

    def tick(self) -> float | None:
        """Publish the stops that are due. Returns the seconds until the next; None while nothing moves."""
        now = self._clock.monotonic()
        for motion in self._motions.values():
            self._stops += motion.tick(now, self._clock.now_us())
            if self._stops == _UNANSWERED:
                self._stops += 1
                _log.error("the agent neither renews nor ends a motion: stopping the robot")
        ends = [at for motion in self._motions.values() if (at := motion.stops.next_due()) is not None]
        return max(0.0, min(ends) - now) if ends else None


def main() -> int:
    """Guard until the agent ends; 1 if the ROS node fails."""
    logging.basicConfig(stream=sys.stderr, format="%(asctime)s %(levelname)s %(name)s: %(message)s")
    # A supervisor or Ctrl-C ends the agent, which ends the guard.
    for number in _SIGNALS:
        signal.signal(number, signal.SIG_IGN)
    # Unbuffered, as `select` needs it.
    with open(sys.stdin.fileno(), "rb", buffering=0, closefd=False) as lines_in:
        guard = _Guard(json.loads(lines_in.readline()))
    guard.node.start()
    answers, waits, rest = False, 1, b""
    left: float | None = None
    while guard.node.failed is None:
        answers = answers or guard.ready()
        if waits and answers:
            # An agent that was killed hears nothing. What it wrote before is read below, to its end.
            with suppress(BrokenPipeError):
                os.write(sys.stdout.fileno(), b"\n" * waits)
            waits = 0
        asleep_s = _IDLE_S if answers else _POLL_S
        readable, _, _ = select.select([sys.stdin], [], [], asleep_s if left is None else min(left, asleep_s))
        if readable:
            data = os.read(sys.stdin.fileno(), _BUFFER)
            if not data:
                return _end(guard)
            *lines, rest = (rest + data).split(b"\n")
            for line in lines:
                guard.take(line)
            waits += len(lines)
        if readable or not answers:
            guard.heard()
        left = guard.tick()
    _log.error("%s", guard.node.failed)
    return 1


def _end(guard: _Guard) -> int:
    over = threading.Event()
    # Now it is nobody's child.
    for number in _SIGNALS:
        signal.signal(number, lambda *_: over.set())
    guard.agent_gone()
    Supervised("guard", lambda: guard.watch(over)).start()
    while not over.is_set() and (left := guard.tick()) is not None:
        over.wait(left)
    guard.node.close()
    return 0


if __name__ == "__main__":
    sys.exit(main())
