"""The guard: a small process that stops the robot if the agent dies or freezes.

It is a ROS node of its own, which the agent starts. The agent tells it the end of each lease before the
command passes, and each emergency stop. If a lease ends that the agent has neither renewed nor ended, or if
the agent is gone, the guard publishes the stop; that of an emergency stop until the agent is back.
`iort_agent.control.motion.guard_process` is the process itself.
"""

from __future__ import annotations

import json
import logging
import os
import subprocess
import sys
from contextlib import suppress
from pathlib import Path
from typing import Any, Mapping

from iort_agent.clock import Clock

_log = logging.getLogger(__name__)

PROCESS = "iort_agent.control.motion.guard_process"
# The guard answers each line with one byte. If it does not within this time, it is frozen.
_ANSWER_S = 1.0
_AGAIN_S = 2.0
# A process that the kernel holds ends later; stops must not wait for it.
_CLOSE_S, _KILLED_S = 3.0, 0.2


class Guard:
    """``agent`` is the name of the agent's node; ``stops`` has the type and the message of each motion's
    stop, by its topic; ``queue`` is the file beside which an emergency stop is kept. Not for several threads
    at once."""

    def __init__(
        self, agent: str, stops: Mapping[str, Mapping[str, Any]], clock: Clock, queue: Path | None = None
    ) -> None:
        kept = str(queue.absolute()) if queue is not None else None
        self._first = _line({"agent": agent, "stops": stops, "queue": kept})
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
        remappings = [one for one in sys.argv if ":=" in one and not one.startswith("__name:=")]
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
