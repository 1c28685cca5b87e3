"""A real ROS 1: a master, publishers and the agent, each in a process of its own.

The agent's Python needs rospy: IORT_ROS_PYTHON names one; otherwise build/ros-venv is made once from
Debian's Python.
"""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import threading
import xmlrpc.client
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from testkit import ROOT
from testkit.ros import SYSTEM_PYTHON, RosGraph, python_with_rospy

SCRIPTS = Path(__file__).resolve().parent / "nodes"
PACKAGES = "python3-rospy python3-rosmaster python3-std-msgs python3-geometry-msgs"
WAIT_S = 120.0


@pytest.fixture(scope="session")
def ros_python() -> str:
    """A Python with rospy and the agent's requirements."""
    given = os.environ.get("IORT_ROS_PYTHON")
    python = given or SYSTEM_PYTHON
    if not Path(python).is_file() or shutil.which("rosmaster") is None:
        pytest.skip(f"ROS 1 is not installed: apt install {PACKAGES}")
    modules = "import rospy, rosmaster, genpy, std_msgs.msg, geometry_msgs.msg"
    tried = subprocess.run([python, "-c", modules], capture_output=True, text=True, check=False)
    if tried.returncode:
        pytest.skip(f"{python} cannot import ROS 1 (apt install {PACKAGES}): {tried.stderr.splitlines()[-1]}")
    return python_with_rospy()


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


class Graph:
    """A ROS graph of its own: master, environment, and the processes in it."""

    def __init__(self, python: str, folder: Path) -> None:
        self.python, self.folder = python, folder
        self._ros = RosGraph(python, folder)
        self.environment = self._ros.environment
        self.master: Process
        self._processes: list[Process] = []

    def start_master(self) -> None:
        self.master = self.start(self._ros.master)
        self._ros.await_master()

    def run(self, script: str, *arguments: object) -> Process:
        return self.start([self.python, str(SCRIPTS / script), *map(str, arguments)])

    def module(self, module: str, *arguments: object) -> Process:
        return self.start([self.python, "-m", module, *map(str, arguments)])

    def parameter(self, name: str, value: Any) -> None:
        with xmlrpc.client.ServerProxy(self.environment["ROS_MASTER_URI"], allow_none=True) as proxy:
            proxy.setParam("/test", name, value)

    def stop(self) -> None:
        for process in reversed(self._processes):
            process.kill()

    def start(self, command: list[str]) -> Process:
        process = Process(command, self.environment)
        self._processes.append(process)
        return process


@pytest.fixture
def graph(ros_python: str, tmp_path: Path) -> Iterator[Graph]:
    found = Graph(ros_python, tmp_path)
    try:
        found.start_master()
        yield found
    finally:
        found.stop()
