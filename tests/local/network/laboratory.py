"""`make up` on one machine, on a small disk, and another machine for a car."""

from __future__ import annotations

import ipaddress
import json
import os
import signal
import socket
import sqlite3
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager, suppress
from pathlib import Path
from typing import Any

from typing_extensions import Self

from iort_contract.catalog.vesc import VESC_STREAM
from iort_station import kept
from iort_station.cloud import EMBEDDED_VARIABLE
from local.deployment import ROOT
from local.processes import Child
from testkit import machine
from testkit.namespaces import ANY, Machine
from testkit.waiting import GUARD_S, InstrumentError, until

BIN = Path(sys.executable).parent


# It takes memory for what is in it only.
_BYTES = 4 * 2**30
_TRIES = 100


class Disk:
    """The disk at an empty folder, from `__enter__` to `__exit__`.

    ``within`` is what a command begins with to run where the disk is mounted, if that is not here.
    """

    def __init__(self, folder: Path, *, within: Sequence[str] = ()) -> None:
        self.folder, self._within = folder, within

    def __enter__(self) -> Self:
        self.folder.mkdir(parents=True)
        self._run("mount", "-t", "tmpfs", "-o", f"size={_BYTES},mode=700", "tmpfs")
        return self

    def __exit__(self, *_: object) -> None:
        self._run("umount", "--lazy")

    @contextmanager
    def full(self) -> Iterator[None]:
        """No byte is free."""
        self._fill()
        try:
            yield
        finally:
            self._resize(_BYTES)

    def _fill(self) -> None:
        for last in (*[False] * _TRIES, True):
            blocks, free, size = self._run("stat", "--file-system", "--format=%b %f %S").split()
            try:
                self._resize((int(blocks) - int(free)) * int(size))
            except InstrumentError:
                # It cannot be smaller than what is in it, and somebody may have written meanwhile.
                if last:
                    raise
            else:
                return

    def _resize(self, size: int) -> None:
        self._run("mount", "-o", f"remount,size={size}")

    def _run(self, *command: str) -> str:
        """Run a command about the folder, and return its output."""
        whole = [*self._within, *command, str(self.folder)]
        done = subprocess.run(whole, capture_output=True, text=True, check=False)
        if done.returncode:
            raise InstrumentError(f"`{' '.join(whole)}` failed: {done.stderr.strip()}")
        return done.stdout


class Laboratory:
    """The machine of the cloud, the car's machine, and `make up` on the first."""

    def __init__(self, folder: Path, cloud: Machine, car: Machine) -> None:
        self.folder, self.cloud, self.car = folder, cloud, car
        # As we and the machine see it: what is mounted there is its own.
        self.state = Path(f"/proc/{cloud.pid}/root{folder}/cloud")
        self.restored, self.backup = self.state.with_name("restored"), folder / "cloud.tar"
        self.disk = Disk(folder / "cloud", within=cloud.command())
        self.up: Child
        self.wait_ready: Callable[[], None]

    @contextmanager
    def running(self, *options: str, ready: bool = True, state: Path | None = None) -> Iterator[None]:
        """Run `make up` until it is killed or the block ends; it says when it is ready, as to systemd."""
        told = self.folder / "notify"
        told.unlink(missing_ok=True)
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as told_by:
            told_by.bind(str(told))
            told_by.settimeout(1.0)
            command = [sys.executable, "-m", "local.up.run", "--state", str(state or self.state), *options]
            self.up = Child(
                "make up",
                self.cloud.command(*command),
                environment={**os.environ, "NOTIFY_SOCKET": str(told)},
                cwd=ROOT,
                log=self.folder / "up.log",
            )
            self.wait_ready = lambda: until(lambda: self._is_ready(told_by), within_s=400)
            try:
                if ready:
                    self.wait_ready()
                yield
            finally:
                self.up.stop()

    def kill(self) -> None:
        """SIGKILL to all processes of `make up` at once, as at a power cut of a machine that has written
        everything."""
        for pid in (self.up.pid, *machine.descendants(self.up.pid)):
            with suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
        self.up.wait(GUARD_S)

    def _is_ready(self, told_by: socket.socket) -> bool:
        self.up.check()
        try:
            return told_by.recv(100) == b"READY=1"
        except TimeoutError:
            return False

    def iort(self, *arguments: str, state: Path | None = None, status: int = 0) -> str:
        """The operator's command, on the cloud's machine."""
        environment = self.environment(state)
        return self.cloud.run(str(BIN / "iort"), *arguments, environment=environment, status=status)

    def environment(self, state: Path | None = None) -> dict[str, str]:
        """The variables with which the operator's command finds the cloud."""
        folder = state or self.state
        return {EMBEDDED_VARIABLE: str(folder / kept.CLOUD), "IORT_STATE": str(folder)}

    def findings(self, status: int) -> dict[str, Any]:
        """What `iort doctor` finds."""
        return {one["what"]: one for one in json.loads(self.iort("doctor", "--json", status=status))}

    def audited(self, state: Path | None = None) -> list[dict[str, Any]]:
        """What `iort audit` finds of the car's streams."""
        told = json.loads(self.iort("audit", "car1", "--json", state=state, status=ANY))
        streams: list[dict[str, Any]] = told["streams"]
        return streams

    def stored(self, state: Path | None = None) -> int:
        """The samples of the car's motor controller."""
        runs = (one["runs"] for one in self.audited(state) if one["stream"] == VESC_STREAM)
        return sum(run["samples"] for found in runs for run in found)

    def listeners(self) -> set[tuple[str, int]]:
        """Every socket of the cloud's machine that a network reaches, whoever listens: TCP and UDP."""
        found = set()
        for table, state in (("tcp", "0A"), ("tcp6", "0A"), ("udp", "07"), ("udp6", "07")):
            for line in Path(f"/proc/{self.cloud.pid}/net/{table}").read_text().splitlines()[1:]:
                address, port = line.split()[1].split(":")
                words = [bytes.fromhex(address[i : i + 8])[::-1] for i in range(0, len(address), 8)]
                host = ipaddress.ip_address(b"".join(words))
                if line.split()[3] == state and not host.is_loopback:
                    found.add((str(host), int(port, 16)))
        return found


def waiting(bundle: Path) -> int:
    """The batches in a car's queue."""
    with closing(sqlite3.connect(f"file:{bundle / 'queue.db'}?mode=ro", uri=True)) as queue:
        ((found,),) = queue.execute("SELECT count(*) FROM batches").fetchall()
    return int(found)
