"""A child process of a test, whose output is read as it comes."""

from __future__ import annotations

import signal
import subprocess
import threading
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from iort_agent.errors import AgentError
from iort_agent.status import fetch
from testkit import ROOT

WAIT_S = 120.0
# An agent gives no notice when it has written all that it received, and neither do ROS' recorders.
_SETTLE_S = 2.0


def settled(socket: Path, streams: Sequence[str]) -> bool:
    """Whether the agent has uploaded all that it received of the streams, files too, and receives nothing
    more; False without an answer."""

    def received() -> tuple[int, list[int]] | None:
        try:
            status = fetch(socket)
        except AgentError:
            return None
        waiting = int(status["spool"]["batches"]) + int((status["files"] or {"waiting": 0})["waiting"])
        return waiting, [status["streams"].get(stream, {}).get("samples", 0) for stream in streams]

    before = received()
    threading.Event().wait(_SETTLE_S)
    after = received()
    return after is not None and after == before and after[0] == 0


class Graph:
    """A graph of either ROS, with the processes in it: ``scripts`` run in its Python and environment."""

    def __init__(self, python: str, folder: Path, environment: dict[str, str], scripts: Path) -> None:
        self.python, self.folder, self.environment = python, folder, environment
        self._scripts = scripts
        self._processes: list[Process] = []

    def run(self, script: str, *arguments: object) -> Process:
        """Run one of nodes/."""
        return self.start([self.python, str(self._scripts / script), *map(str, arguments)])

    def module(self, module: str, *arguments: object) -> Process:
        return self.start([self.python, "-m", module, *map(str, arguments)])

    def listener(self, name: str, topic: str, kind: str) -> Process:
        """Run a foreign subscriber, whose lines are ``connected``, then ``[time, message]``."""
        return self.run("listener.py", name, topic, kind)

    def start(self, command: list[str]) -> Process:
        process = Process(command, self.environment)
        self._processes.append(process)
        return process

    def stop(self) -> None:
        for process in reversed(self._processes):
            process.kill()


class Process:
    """A child whose output is read as it comes; the input line `quit` asks it to end."""

    def __init__(self, command: list[str], environment: dict[str, str]) -> None:
        self._process = subprocess.Popen(
            command,
            env=environment,
            cwd=ROOT,
            text=True,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            start_new_session=True,
        )
        self.pid = self._process.pid
        self.lines: list[str] = []
        self.errors: list[str] = []
        self._news = threading.Condition()
        self._unread = 2  # streams
        self._readers = [
            threading.Thread(target=self._read, args=(stream, lines), daemon=True)
            for stream, lines in ((self._process.stdout, self.lines), (self._process.stderr, self.errors))
        ]
        for reader in self._readers:
            reader.start()

    def _read(self, stream: Any, lines: list[str]) -> None:
        for line in stream:
            with self._news:
                lines.append(line.rstrip("\n"))
                self._news.notify_all()
        with self._news:
            self._unread -= 1
            self._news.notify_all()

    def until(self, condition: Callable[[], Any], what: str) -> Any:
        """Wait for output that makes the condition true."""
        found = self.within(WAIT_S, condition)
        assert found, f"no {what}; {self.lines[-3:]}\n" + "\n".join(self.errors[-25:])
        return found

    def within(self, seconds: float, condition: Callable[[], Any]) -> Any:
        """Wait for output that makes the condition true, but no longer than that."""
        with self._news:
            # A process that has ended may have written more than is read yet.
            self._news.wait_for(lambda: condition() or not self._unread, seconds)
            return condition()

    def alive(self) -> bool:
        """Whether it still runs."""
        return self._process.poll() is None

    def status(self, socket: Path) -> dict[str, Any]:
        """What an agent tells of itself; nothing while it starts."""
        assert self.alive(), "\n".join(self.errors[-25:])
        try:
            return fetch(socket)
        except AgentError:
            return {}

    def until_said(self, text: str) -> None:
        """Wait for a text in the log."""
        self.until(lambda: any(text in line for line in self.errors), f"{text!r} in its log")

    def say(self, line: str) -> None:
        """Write a line on its input."""
        assert self._process.stdin is not None
        self._process.stdin.write(f"{line}\n")
        self._process.stdin.flush()

    def quit(self) -> list[str]:
        """Ask it to end; return all lines of its output."""
        if self._process.poll() is None:
            self.say("quit")
        assert self._process.wait(WAIT_S) == 0, "\n".join(self.errors[-25:])
        for reader in self._readers:
            reader.join(WAIT_S)
        return self.lines

    def wait(self) -> None:
        """Wait until it ends by itself, without error."""
        assert self.ended() == 0, "\n".join(self.errors[-25:])

    def terminate(self) -> int:
        """End it as a supervisor does; return its status."""
        self._process.terminate()
        return self.ended()

    def ended(self) -> int:
        """Wait until it ends by itself; return its status."""
        status = self._process.wait(WAIT_S)
        for reader in self._readers:
            reader.join(WAIT_S)
        return status

    def interrupt(self) -> None:
        """End it as Ctrl-C does."""
        self._process.send_signal(signal.SIGINT)
        self.wait()

    def signal(self, number: int) -> None:
        """Send it a signal."""
        self._process.send_signal(number)

    def kill(self) -> None:
        """End it at once."""
        self._process.kill()
        self._process.wait()
        for reader in self._readers:
            reader.join(WAIT_S)
        for stream in (self._process.stdin, self._process.stdout, self._process.stderr):
            if stream is not None:
                stream.close()
