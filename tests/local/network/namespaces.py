"""Two machines on one cable: network namespaces, as root or in a user namespace of one's own."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path

import pytest

from local.processes import Child
from testkit.waiting import GUARD_S

ANY = -1
TOOLS = ("ip", "nsenter", "unshare")


@dataclass(frozen=True)
class Machine:
    """A namespace with an address of each kind."""

    pid: int
    address: str
    address6: str

    def command(self, *command: str) -> list[str]:
        """A command as it is run on this machine."""
        there = ["--user", "--net", "--mount", "--wd=.", "--preserve-credentials"]
        return ["nsenter", f"--target={self.pid}", *there, *command]

    def run(self, *command: str, environment: Mapping[str, str] | None = None, status: int = 0) -> str:
        """Run a command to its end, with that exit status or any, and return its output."""
        done = subprocess.run(
            self.command(*command),
            env={**os.environ, **(environment or {})},
            capture_output=True,
            text=True,
            timeout=GUARD_S,
            check=False,
        )
        assert status in (done.returncode, ANY), f"{command}: {done.stdout}{done.stderr}"
        return done.stdout or done.stderr


@contextmanager
def two_machines(folder: Path) -> Iterator[tuple[Machine, Machine]]:
    """Two machines, 10.77.0.1 and 10.77.0.2, fd77::1 and fd77::2, with file systems of their own in common.
    Skips where they cannot be made."""
    missing = [tool for tool in TOOLS if shutil.which(tool) is None]
    if missing:
        pytest.skip(f"{missing[0]} is not installed: apt-get install iproute2 util-linux")
    made = ["unshare", "--user", "--map-root-user", "--net", "--mount"]
    if subprocess.run([*made, "true"], capture_output=True, check=False).returncode:
        pytest.skip("this machine allows neither root nor users network namespaces of their own")
    with ExitStack() as stack:

        def stays(name: str, command: list[str]) -> int:
            child = Child(
                name,
                [*command, "sleep", "infinity"],
                environment=os.environ,
                cwd=folder,
                log=folder / f"{name}.log",
                orphaned=signal.SIGKILL,
            )
            stack.callback(child.kill)
            namespace = Path(f"/proc/{child.pid}/ns/net")
            while namespace.readlink() == Path("/proc/self/ns/net").readlink():
                child.check()
            return child.pid

        one = Machine(stays("one", made), "10.77.0.1", "fd77::1")
        enter = ["nsenter", f"--target={one.pid}", "--user", "--mount", "--wd=.", "--preserve-credentials"]
        inside = [*enter, "unshare", "--net"]
        other = Machine(stays("other", inside), "10.77.0.2", "fd77::2")
        one.run(
            "ip", "link", "add", "cable", "type", "veth", "peer", "name", "cable", "netns", str(other.pid)
        )
        for machine in (one, other):
            machine.run("ip", "address", "add", f"{machine.address}/24", "dev", "cable")
            # At once: nobody else can have it.
            machine.run("ip", "address", "add", f"{machine.address6}/64", "dev", "cable", "nodad")
            machine.run("ip", "link", "set", "cable", "up")
            machine.run("ip", "link", "set", "lo", "up")
        yield one, other
