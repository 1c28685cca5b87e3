"""Runs a ROS 1 master on a free port, and nodes under a Python that has rospy."""

from __future__ import annotations

import fcntl
import os
import shutil
import socket
import subprocess
import time
import xmlrpc.client
from pathlib import Path

from typing_extensions import Self

from testkit import ROOT
from testkit.waiting import InstrumentError

SYSTEM_PYTHON = "/usr/bin/python3"
# The packages of the checkout that a node imports; the Python with rospy has none of them installed.
PYTHONPATH = os.pathsep.join(str(ROOT / folder) for folder in ("", "contract", "device"))
PACKAGES = "python3-rospy python3-rosmaster python3-std-msgs python3-venv"
_START_S = 120.0


class RosError(InstrumentError):
    """ROS 1 is not installed or does not start; the text says how to fix it."""


def python_with_rospy() -> str:
    """Return a Python with rospy and the agent's requirements: IORT_ROS_PYTHON, or one made in build/."""
    given = os.environ.get("IORT_ROS_PYTHON")
    if given:
        return given
    if shutil.which("rosmaster") is None:
        raise RosError(f"ROS 1 is not installed: apt install {PACKAGES}")
    folder = ROOT / "build" / "ros-venv"
    python, ready = folder / "bin" / "python", folder / "ready-with-video"
    folder.parent.mkdir(exist_ok=True)
    with folder.with_suffix(".lock").open("w") as lock:
        # Tests side by side make it once.
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not ready.exists():
            shutil.rmtree(folder, ignore_errors=True)
            subprocess.run([SYSTEM_PYTHON, "-m", "venv", "--system-site-packages", folder], check=True)
            subprocess.run(
                [
                    python,
                    "-m",
                    "pip",
                    "install",
                    "-q",
                    "awsiotsdk>=1.22,<2",
                    "mcap>=1.6,<2",
                    "av>=12,<20",
                    "pillow>=10.4",
                ],
                check=True,
            )
            ready.touch()
    return str(python)


class Nodes:
    """The processes of a graph, from `__enter__` to `__exit__`, each with a log in ``folder``."""

    def __init__(self, python: str, folder: Path, environment: dict[str, str]) -> None:
        self._python, self._folder, self.environment = python, folder, environment
        self._processes: list[subprocess.Popen[str]] = []

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        for process in reversed(self._processes):
            process.kill()
            process.communicate()

    def start(self, module: str, *arguments: object) -> subprocess.Popen[str]:
        """Run a module under the Python that has the ROS."""
        return self.run([self._python, "-m", module, *map(str, arguments)])

    def run(self, command: list[str]) -> subprocess.Popen[str]:
        with (self._folder / f"{len(self._processes)}.log").open("w") as log:
            process = subprocess.Popen(
                command,
                env=self.environment,
                cwd=ROOT,
                text=True,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=log,
            )
        self._processes.append(process)
        return process


class RosGraph(Nodes):
    """A master that runs from `__enter__` to `__exit__`; `start` adds nodes."""

    def __init__(self, python: str, folder: Path) -> None:
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            port = int(probe.getsockname()[1])
        environment = {
            **{name: value for name, value in os.environ.items() if not name.startswith("ROS_")},
            "ROS_MASTER_URI": f"http://127.0.0.1:{port}",
            "ROS_IP": "127.0.0.1",
            "ROS_LOG_DIR": str(folder),
            "ROS_HOME": str(folder),
            "PYTHONPATH": PYTHONPATH,
            "PYTHONUNBUFFERED": "1",
        }
        super().__init__(python, folder, environment)
        self.master = [SYSTEM_PYTHON, str(shutil.which("rosmaster")), "--core", "-p", str(port)]

    def __enter__(self) -> Self:
        self.run(self.master)
        self.await_master()
        return self

    def await_master(self) -> None:
        """Wait until the master answers. Raises `RosError`."""
        deadline = time.monotonic() + _START_S
        while True:
            try:
                with xmlrpc.client.ServerProxy(self.environment["ROS_MASTER_URI"]) as master:
                    master.getPid("/bench")
            except OSError as error:
                if time.monotonic() > deadline:
                    raise RosError(f"rosmaster does not answer: {error}") from error
                # The master does not report when it is ready.
                time.sleep(0.05)
            else:
                return

    def publisher(
        self, node: str, seconds: float, subscribers: int = 2, rate_hz: float | None = None
    ) -> Publisher:
        """Return a node of the robot, which publishes its topics for ``seconds`` after `Publisher.go`."""
        rate = [] if rate_hz is None else [rate_hz]
        return Publisher(self.start("bench.ros.publisher", node, seconds, subscribers, *rate))


class Publisher:
    """A publisher in its own process; methods raise `RosError` after the process has ended."""

    def __init__(self, process: subprocess.Popen[str]) -> None:
        self._process = process

    def ready(self) -> None:
        """Wait for all subscribers."""
        self._hear()

    def go(self) -> None:
        assert self._process.stdin is not None
        self._process.stdin.write("\n")
        self._process.stdin.flush()

    def publish_for(self, seconds: float) -> None:
        try:
            self._process.wait(seconds)
        except subprocess.TimeoutExpired:
            return
        raise RosError(f"the publisher stopped with status {self._process.returncode}")

    def finish(self) -> str:
        """Wait until everything is published; return the line that it prints."""
        return self._hear()

    def _hear(self) -> str:
        assert self._process.stdout is not None
        line = self._process.stdout.readline()
        if not line:
            raise RosError(f"the publisher stopped with status {self._process.wait()}")
        return line
