"""The guard's process: `iort_agent.control.motion.guard` starts it and explains it.

Its input is lines of JSON: first its node's name and the stops, then the end of a motion's lease, by the
machine's monotonic clock, or null. It answers each line with a byte, and begins once it is in the ROS graph.
The end of the input is the agent's end.
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
from typing import Any, Mapping

from iort_agent.clock import SystemClock
from iort_agent.control.motion.stops import Stops
from iort_agent.ros1.json_message import encode
from iort_agent.ros1.node import Node, shared

_log = logging.getLogger("iort_agent.guard")
# The stop of a lease that the agent has certainly not ended.
_UNANSWERED = 2
_POLL_S, _IDLE_S = 0.05, 4.0
_CONNECT_S = 2.0
_BUFFER = 65_536


class _Motion:
    """One motion's stop, and when it is due."""

    def __init__(self, node: Node, config: Mapping[str, Any]) -> None:
        self.stops = Stops()
        self._node, self._topic, self._stop = node, config["topic"], config["stop"]
        self._definition = node.definition(config["type"])
        node.advertise(self._topic, config["type"])

    def heard(self) -> bool:
        return self._node.listeners(self._topic) > 0

    def tick(self, now: float, now_us: int) -> bool:
        if not self.stops.stop_due(now):
            return False
        self._node.publish(self._topic, encode(self._definition, self._stop, now_us=now_us, partial=True))
        return True


class _Guard:
    def __init__(self, config: Mapping[str, Any]) -> None:
        self.node, self._clock = shared(config["node"]), SystemClock()
        self._motions = {name: _Motion(self.node, one) for name, one in config["stops"].items()}
        # Stops since the last news of a lease. At its end the agent publishes a stop itself, and tells it.
        self._stops = 0
        self._joined: float | None = None

    def ready(self) -> bool:
        """Whether the stops would be heard: the topics' subscribers have connected, or had the time to."""
        if not self.node.ready.is_set():
            return False
        now = self._clock.monotonic()
        self._joined = now if self._joined is None else self._joined
        return all(map(_Motion.heard, self._motions.values())) or now - self._joined > _CONNECT_S

    def take(self, line: bytes) -> None:
        """Take the end of a lease; an empty line only asks for an answer."""
        if not line.strip():
            return
        name, until = json.loads(line)
        stops = self._motions[name].stops
        if until is None:
            self._motions[name].stops = Stops()
        else:
            stops.move(until)
        self._stops = 0

    def agent_gone(self) -> None:
        """End every lease now."""
        for motion in self._motions.values():
            motion.stops.cut(self._clock.monotonic())

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
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
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
        left = guard.tick()
    _log.error("%s", guard.node.failed)
    return 1


def _end(guard: _Guard) -> int:
    guard.agent_gone()
    while (left := guard.tick()) is not None:
        threading.Event().wait(left)
    guard.node.close()
    return 0


if __name__ == "__main__":
    sys.exit(main())
