"""Machines on cables: network namespaces, as root or in a user namespace of one's own.

They have no names, and end with their processes, so nothing of them is left however the run ends."""

from __future__ import annotations

import json
import os
import shutil
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path

from local.processes import Child
from testkit.waiting import GUARD_S, InstrumentError, until

ANY = -1
TOOLS = ("ip", "nsenter", "unshare")
_STAY = ("sleep", "infinity")
_MADE = ("unshare", "--user", "--map-root-user", "--net", "--mount")
# A process in a namespace makes a socket there and hands it over; it stays a socket of the namespace.
_GIVER = """
import json, socket, sys
door = socket.socket(fileno=int(sys.argv[1]))
asked = json.loads(sys.argv[2])
made = socket.socket(asked["family"], asked["kind"])
made.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
if asked["bind"]: made.bind(tuple(asked["bind"]))
if asked["listen"]: made.listen(64)
socket.send_fds(door, [b"."], [made.fileno()])
"""


class NoNamespacesError(InstrumentError):
    """No network namespaces are here, or not for this user; the text says what is lacking."""


@dataclass(frozen=True)
class Machine:
    """A namespace with an address of each kind, if it is on a cable."""

    pid: int
    address: str = ""
    address6: str = ""

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

    def socket(
        self,
        kind: socket.SocketKind = socket.SOCK_STREAM,
        *,
        family: socket.AddressFamily = socket.AF_INET,
        bind: tuple[str | int, int] | None = None,
        listen: bool = False,
    ) -> socket.socket:
        """A socket of this machine's network, in our hands. Raises `InstrumentError`."""
        asked = json.dumps({"family": family, "kind": kind, "bind": bind, "listen": listen})
        ours, theirs = socket.socketpair()
        with ours, theirs:
            command = self.command(sys.executable, "-c", _GIVER, str(theirs.fileno()), asked)
            done = subprocess.run(
                command, pass_fds=[theirs.fileno()], capture_output=True, text=True, check=False
            )
            if done.returncode:
                raise InstrumentError(f"no socket at {bind} of the other machine: {done.stderr.strip()}")
            _, (made,), _, _ = socket.recv_fds(ours, 1, 1)
        return socket.socket(fileno=made)


@contextmanager
def machines(folder: Path, *names: str) -> Iterator[list[Machine]]:
    """Machines that know nobody, with file systems of their own in common. Raises `NoNamespacesError` where
    they cannot be made."""
    missing = [tool for tool in TOOLS if shutil.which(tool) is None]
    if missing:
        raise NoNamespacesError(f"{missing[0]} is not installed: apt-get install iproute2 util-linux")
    if subprocess.run([*_MADE, "true"], capture_output=True, check=False).returncode:
        raise NoNamespacesError("this machine allows neither root nor users network namespaces of their own")
    stay = b"".join(word.encode() + b"\0" for word in _STAY)
    with ExitStack() as stack:

        def stays(name: str, command: list[str]) -> Machine:
            child = Child(
                name,
                [*command, *_STAY],
                environment=os.environ,
                cwd=folder,
                log=folder / f"{name}.log",
                orphaned=signal.SIGKILL,
            )
            stack.callback(child.kill)
            # It has its namespaces before they know its user: until then they allow us nothing.
            until(lambda: child.poll() is not None or Path(f"/proc/{child.pid}/cmdline").read_bytes() == stay)
            child.check()
            machine = Machine(child.pid)
            machine.run("ip", "link", "set", "lo", "up")
            return machine

        first, *others = names
        root = stays(first, [*_MADE])
        enter = [f"--target={root.pid}", "--user", "--mount", "--wd=.", "--preserve-credentials"]
        yield [root, *(stays(name, ["nsenter", *enter, "unshare", "--net"]) for name in others)]


def lay_cable(one: Machine, end: str, other: Machine, other_end: str) -> None:
    """A cable between two machines, with a name at each end, without addresses."""
    peer = ("peer", "name", other_end, "netns", str(other.pid))
    one.run("ip", "link", "add", end, "type", "veth", *peer)
    one.run("ip", "link", "set", end, "up")
    other.run("ip", "link", "set", other_end, "up")


def addressed(machine: Machine, end: str, number: int) -> Machine:
    """The machine with its addresses at the end of a cable: 10.77.0.1 and fd77::1, 10.77.0.2 ..."""
    known = Machine(machine.pid, f"10.77.0.{number}", f"fd77::{number}")
    known.run("ip", "address", "add", f"{known.address}/24", "dev", end)
    # At once: nobody else can have it.
    known.run("ip", "address", "add", f"{known.address6}/64", "dev", end, "nodad")
    return known


@contextmanager
def two_machines(folder: Path) -> Iterator[tuple[Machine, Machine]]:
    """Two machines on one cable, 10.77.0.1 and 10.77.0.2. Raises `NoNamespacesError`."""
    with machines(folder, "one", "other") as (one, other):
        lay_cable(one, "cable", other, "cable")
        yield addressed(one, "cable", 1), addressed(other, "cable", 2)
