"""What stops the robot when the agent dies or freezes: a small process, and a file for the next run.

The guard is a node of its own in the agent's ROS graph, in a process that the agent starts
(`python -m iort_agent.control.guard`). The agent tells it the end of each lease before the command passes,
and each emergency stop. If a lease ends that the agent has neither renewed nor ended, or if the agent is
gone, the guard publishes the stop; that of an emergency stop until the agent is back.

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
import subprocess
import sys
import threading
from contextlib import suppress
from pathlib import Path
from typing import Any, Callable, Mapping, Union

from iort_agent.common.threads import Clock, Supervised, SystemClock
from iort_agent.control.leases import Stops
from iort_agent.ros import ros1_node, ros2_node
from iort_agent.ros.arguments import for_another
from iort_agent.ros.json_message import encode

_log = logging.getLogger("iort_agent.guard")

Node = Union[ros1_node.Node, ros2_node.Node]
# Gives the process' node in the graph of a ROS, 1 or 2.
NODES: dict[int, Callable[..., Node]] = {1: ros1_node.shared, 2: ros2_node.shared}

PROCESS = "iort_agent.control.guard"
# The guard answers each line with one byte. If it does not within this time, it is frozen.
_ANSWER_S = 1.0
_AGAIN_S = 2.0
# A process that the kernel holds ends later; stops must not wait for it.
_CLOSE_S, _KILLED_S = 3.0, 0.2
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


class StopFile:
    """The emergency stop over a restart of the agent: a file beside the queue's, while it holds.

    `stopped` is what is in force, at first what the last run wrote. Without a queue in a file the stop is
    known again once the agent is connected.
    """

    def __init__(self, queue: Path | None) -> None:
        self._file = queue.with_name(f"{queue.name}.stopped") if queue is not None else None
        self.stopped = self._written = self._file is not None and self._file.exists()
        # Why the next run would not know it.
        self.alarm: str | None = None

    def write(self, *, stopped: bool) -> None:
        """Write it for the next run. A disk that does not work is no reason not to stop."""
        self.stopped = stopped
        self.tick()

    def tick(self) -> None:
        """Try again what the disk did not do."""
        if self._file is None or self.stopped == self._written:
            return
        stopped = self.stopped
        try:
            if stopped:
                self._file.touch(mode=0o600)
            else:
                self._file.unlink(missing_ok=True)
            folder = os.open(self._file.parent, os.O_RDONLY)
            try:
                os.fsync(folder)
            finally:
                os.close(folder)
        except OSError as error:
            if self.alarm is None:
                _log.error("%s: the emergency stop cannot be kept over a restart: %s", self._file, error)
            self.alarm = f"{self._file}: a restart would not know the emergency stop or its end: {error}"
        else:
            self._written, self.alarm = stopped, None


class Guard:
    """``agent`` is the name of the agent's node in the graph of ``ros``, 1 or 2; ``stops`` has the type and
    the message of each motion's stop, by its topic; ``queue`` is the file beside which an emergency stop is
    kept. Not for several threads at once."""

    def __init__(
        self,
        agent: str,
        stops: Mapping[str, Mapping[str, Any]],
        clock: Clock,
        queue: Path | None = None,
        *,
        ros: int = 1,
    ) -> None:
        file = str(queue.absolute()) if queue is not None else None
        self._agent = agent
        self._first = _line({"agent": agent, "ros": ros, "stops": stops, "queue": file})
        self._clock = clock
        self._process: subprocess.Popen[bytes] | None = None
        # What it must know after a restart, by topic.
        self._told: dict[str, bytes] = {}
        # Lines that the guard has not answered, and since when. The first answer says: in the ROS graph.
        self._waiting = 0
        self._since = 0.0
        self._in_graph = False
        self._start_at: float | None = None

    def start(self) -> None:
        """Start the process."""
        self._start_at = self._clock.monotonic()
        self.tick()

    def ready(self) -> bool:
        """Whether it would stop the robot now."""
        self._read()
        frozen = self._waiting > 0 and self._clock.monotonic() - self._since > _ANSWER_S
        return self._in_graph and not frozen and self._running()

    def tell(self, topic: str, until: float | None, *, held: bool) -> bool:
        """Tell the end of a motion's lease, by the monotonic clock, None if it has ended; and whether an
        emergency stop holds. Whether that was possible."""
        self._told[topic] = _line([topic, until, held])
        return self._write(self._told[topic])

    def tick(self, *, stops: bool = True) -> None:
        """Start it again if it has died or frozen; called at least every second or so. ``stops`` tells
        whether the agent can publish its stops; if not, the guard publishes those of an emergency stop."""
        now = self._clock.monotonic()
        if self._start_at is None or now < self._start_at:
            return
        if self._in_graph and not self.ready():
            _log.error(
                "the guard %s: motion is refused until it runs again", "froze" if self._running() else "died"
            )
            self._kill()
        if self._running():
            if self._in_graph and stops:
                self._write(b"\n")
            return
        self._start_at = now + _AGAIN_S
        remappings = for_another(sys.argv[1:], self._agent)
        try:
            self._process = subprocess.Popen(  # noqa: S603 - our own module
                [sys.executable, "-m", PROCESS, *remappings],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                start_new_session=True,
            )
        except OSError as error:  # no memory, no process left
            _log.error("the guard cannot be started, and motion is refused: %s", error)
            return
        for pipe in (self._process.stdin, self._process.stdout):
            assert pipe is not None
            os.set_blocking(pipe.fileno(), False)
        self._in_graph, self._waiting = False, 0
        self._write(self._first)
        for line in self._told.values():
            self._write(line)

    def close(self, *, leave: bool = False) -> None:
        """End the process; it publishes the stops that are due before. ``leave`` an emergency stop to it."""
        self._start_at = None
        if self._process is None:
            return
        assert self._process.stdin is not None
        self._process.stdin.close()
        if leave:
            return
        with suppress(subprocess.TimeoutExpired):
            self._process.wait(_CLOSE_S)
        self._kill()

    def _running(self) -> bool:
        return self._process is not None and self._process.poll() is None

    def _kill(self) -> None:
        self._in_graph = False
        if self._process is None:
            return
        self._process.kill()
        with suppress(subprocess.TimeoutExpired):
            self._process.wait(_KILLED_S)
        for pipe in (self._process.stdin, self._process.stdout):
            assert pipe is not None
            pipe.close()

    def _write(self, line: bytes) -> bool:
        if self._process is None or self._process.stdin is None:
            return False
        try:
            written = os.write(self._process.stdin.fileno(), line)
        except (OSError, ValueError):  # it is gone, or its pipe is full
            return False
        if not self._waiting:
            self._since = self._clock.monotonic()
        self._waiting += 1
        return written == len(line)

    def _read(self) -> None:
        if self._process is None or self._process.stdout is None:
            return
        try:
            answers = len(os.read(self._process.stdout.fileno(), 65_536))
        except (OSError, ValueError):  # nothing yet, or it was killed
            return
        if answers:
            self._in_graph = True
            self._waiting = max(0, self._waiting - answers)
            self._since = self._clock.monotonic()


def _line(content: Any) -> bytes:
    return json.dumps(content, separators=(",", ":")).encode() + b"\n"


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
        self.node, self._clock = NODES[config["ros"]](f"{self._agent}_guard"), SystemClock()
        self._motions = {topic: _Motion(self.node, topic, stop) for topic, stop in config["stops"].items()}
        # Stops since the last news of a lease. At its end the agent publishes a stop itself, and tells it.
        self._stops = 0
        self._joined: float | None = None
        self._queue: str | None = config.get("queue")
        # The agent that has died: in ROS 2 it seems to live for a while.
        self._gone: frozenset[str] | None = None

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
            StopFile(Path(self._queue)).write(stopped=True)
        seen = 0
        if self._gone is None:
            self._gone = self.node.living(self._agent)
        while not over.wait(_LOOK_S):
            living = self.node.living(self._agent)
            self._gone &= living
            seen = seen + 1 if living - self._gone else 0
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
