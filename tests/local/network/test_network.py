"""`make up` on one machine and a car on another: what the network reaches, and what kills leave. Then systemd
runs the same cloud."""

from __future__ import annotations

import ipaddress
import os
import signal
import socket
import sqlite3
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, contextmanager, suppress
from pathlib import Path

import pytest

from bench.keeping.disk import Disk
from bench.meters import usage
from iort_station import kept
from iort_station.cloud import EMBEDDED_VARIABLE
from local.deployment import ROOT
from local.processes import Child
from local.up.down import stop
from local.up.service import NAME
from tests.local.conftest import until
from tests.local.network.booted import booted
from tests.local.network.namespaces import Machine, two_machines

BIN = Path(sys.executable).parent
# The issue asks for 20 s on a machine that does nothing else.
SECOND_START_S = 60.0


class Laboratory:
    """The machine of the cloud, the car's machine, and `make up` on the first."""

    def __init__(self, folder: Path, cloud: Machine, car: Machine) -> None:
        self.folder, self.cloud, self.car = folder, cloud, car
        # As we and the machine see it: what is mounted there is its own.
        self.state = Path(f"/proc/{cloud.pid}/root{folder}/cloud")
        self.disk = Disk(folder / "cloud", within=cloud.command())
        self.up: Child
        self.wait_ready: Callable[[], None]

    @contextmanager
    def running(self, *options: str, ready: bool = True) -> Iterator[None]:
        """Run `make up` until it is killed or the block ends; it says when it is ready, as to systemd."""
        told = self.folder / "notify"
        told.unlink(missing_ok=True)
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as told_by:
            told_by.bind(str(told))
            told_by.settimeout(1.0)
            command = [sys.executable, "-m", "local.up.run", "--state", str(self.state), *options]
            self.up = Child(
                "make up",
                self.cloud.command(*command),
                environment={**os.environ, "NOTIFY_SOCKET": str(told)},
                cwd=ROOT,
                log=self.folder / "up.log",
            )
            self.wait_ready = lambda: until(lambda: self._is_ready(told_by), seconds=400)
            try:
                if ready:
                    self.wait_ready()
                yield
            finally:
                self.up.stop()

    def kill(self) -> None:
        """SIGKILL to all processes of `make up` at once, as at a power cut of a machine that has written
        everything."""
        for pid in (self.up.pid, *usage.descendants(self.up.pid)):
            with suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
        self.up.wait(10.0)

    def _is_ready(self, told_by: socket.socket) -> bool:
        self.up.check()
        try:
            return told_by.recv(100) == b"READY=1"
        except TimeoutError:
            return False

    def iort(self, *arguments: str) -> str:
        """The operator's command, on the cloud's machine."""
        environment = {EMBEDDED_VARIABLE: str(self.state / kept.CLOUD)}
        return self.cloud.run(str(BIN / "iort"), *arguments, environment=environment)

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


@pytest.fixture(scope="module")
def laboratory(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Laboratory]:
    folder = tmp_path_factory.mktemp("laboratory")
    with two_machines(folder) as (cloud, car):
        laboratory = Laboratory(folder, cloud, car)
        with laboratory.disk:
            yield laboratory


@pytest.fixture
def car(laboratory: Laboratory) -> Iterator[Callable[..., Child]]:
    """Run the agent of a bundle on the car's machine: `car(folder, "run", ...)`."""
    with ExitStack() as stack:

        def start(bundle: Path, *arguments: str) -> Child:
            command = [str(BIN / "iort-agent"), *arguments, "--config", str(bundle / "car.yaml")]
            child = Child(
                "the car",
                laboratory.car.command(*command),
                environment=os.environ,
                cwd=ROOT,
                log=laboratory.folder / "car.log",
            )
            stack.callback(child.stop)
            return child

        yield start


def waiting(bundle: Path) -> int:
    """The batches in a car's queue."""
    with closing(sqlite3.connect(f"file:{bundle / 'queue.db'}?mode=ro", uri=True)) as queue:
        ((found,),) = queue.execute("SELECT count(*) FROM batches").fetchall()
    return int(found)


def test_a_first_deployment_that_a_kill_interrupts_is_made_up_for(laboratory):
    log = laboratory.state / "cdk-deploy.log"
    with laboratory.running(ready=False):
        # The middle one of eight stacks.
        until(lambda: log.exists() and "processing: creating stack" in log.read_text(), seconds=400)
        laboratory.kill()
    with laboratory.running():
        assert "registered" in laboratory.iort("robots", "add", "car0", "--out", str(laboratory.folder))


def test_a_car_in_another_namespace_drives_through_kills_and_loses_nothing(laboratory, car):
    address = laboratory.cloud.address
    bundle = laboratory.folder / "car1"
    with laboratory.running("--listen", address, "--page", address):
        ports = kept.Up.load(laboratory.state).ports
        reached = {(address, ports[name]) for name in ("mqtt", "files", "network page")}
        assert laboratory.listeners() == reached
        laboratory.iort("robots", "add", "car1", "--out", str(laboratory.folder))
        agent = car(bundle, "run")
        until(lambda: "connected" in agent.tail())
        until(lambda: "vesc" in laboratory.iort("streams", "car1"))
        first = kept.Up.load(laboratory.state)
        # An emulator that ends is started again.
        os.kill(first.pids["emulator"], signal.SIGKILL)
        laboratory.wait_ready()
        up = kept.Up.load(laboratory.state)
        assert up.pids["up"] == first.pids["up"]
        assert up.pids["emulator"] != first.pids["emulator"]
        assert laboratory.listeners() == reached
        with laboratory.disk.full():
            # The broker refuses each batch, and the car keeps it.
            until(lambda: waiting(bundle) > 3)
            assert agent.poll() is None
        until(lambda: waiting(bundle) < 2)
        laboratory.kill()
    began = time.monotonic()
    # What was opened stays open, and the ports are those of the bundle.
    with laboratory.running():
        assert time.monotonic() - began < SECOND_START_S
        assert laboratory.listeners() == reached
        # It is back by itself; the batches in between have waited in its queue.
        until(lambda: "online since" in laboratory.iort("robots", "list"))
        agent.interrupt()
        assert agent.wait(30.0) == 0, agent.tail()
        until(lambda: "offline since" in laboratory.iort("robots", "list"))
        until(lambda: "vesc: complete" in laboratory.iort("audit", "car1"))
        upload = laboratory.folder / "drive.bag"
        upload.write_bytes(os.urandom(100_000))
        sent = car(bundle, "upload", str(upload))
        assert sent.wait(60.0) == 0, sent.tail()
        assert "drive.bag" in laboratory.iort("files", "list", "car1")
        check = [str(BIN / "iort-agent"), "check", "--config", str(bundle / "car.yaml")]
        # A car of the cloud's own machine that was registered before LISTEN.
        config = bundle / "car.yaml"
        (bundle / "here.yaml").write_text(config.read_text().replace(address, "127.0.0.1"))
        here = laboratory.cloud.run(*check[:-1], str(bundle / "here.yaml"))
        assert "rules: answer a ping" in here
        way = laboratory.car.run(*check)
        assert f"route: from {laboratory.car.address} to {address}" in way
        assert "rules: answer a ping" in way
        assert f"cars connect to {address}:{ports['mqtt']}" in laboratory.iort("doctor")
        assert stop(laboratory.state)
    assert laboratory.listeners() == set()
    ended = laboratory.car.run("sh", "-c", '"$@" || true', "sh", *check)
    assert f"port: {address} answers, but nothing listens on {ports['mqtt']}" in ended


def test_a_car_reaches_the_cloud_by_ipv6(laboratory, car):
    address = laboratory.cloud.address6
    bundle = laboratory.folder / "car6"
    with laboratory.running("--listen", address, "--page", f"{address},cloud.lab"):
        ports = kept.Up.load(laboratory.state).ports
        reached = {(address, ports[name]) for name in ("mqtt", "files", "network page")}
        assert laboratory.listeners() == reached
        laboratory.iort("robots", "add", "car6", "--out", str(laboratory.folder))
        check = [str(BIN / "iort-agent"), "check", "--config", str(bundle / "car.yaml")]
        assert "rules: answer a ping" in laboratory.car.run(*check)
        upload = laboratory.folder / "drive.bag"
        upload.write_bytes(b"samples")
        sent = car(bundle, "upload", str(upload))
        assert sent.wait(60.0) == 0, sent.tail()
        assert "drive.bag" in laboratory.iort("files", "list", "car6")
        assert f"cars connect to [{address}]:{ports['mqtt']}" in laboratory.iort("doctor")


def test_systemd_starts_the_cloud_again_after_a_kill_and_stops_it(laboratory):
    def service(*options: str) -> None:
        machine.run(sys.executable, "-m", "local.up.service", "--state", str(laboratory.state), *options)

    def said(key: str) -> str:
        return machine.run("systemctl", "show", NAME, "--property", key, "--value").strip()

    with booted(laboratory.folder) as machine:
        service("--listen", "127.0.0.5,iort.lab", "--page", "no")
        # Starting it ends when it is ready.
        assert (said("ActiveState"), said("UnitFileState")) == ("active", "enabled")
        main = said("MainPID")
        machine.run("kill", "-KILL", main)
        until(lambda: said("ActiveState") == "active" and said("MainPID") not in {"0", main})
        assert said("NRestarts") == "1"
        doctor = machine.run(str(BIN / "iort"), "doctor", IORT_STATE=str(laboratory.state))
        assert f"processes: up {said('MainPID')}, emulator " in doctor
        assert "ok    servers: all answer" in doctor
        assert "connect to iort.lab:" in machine.run("journalctl", "--identifier", "iort-cloud")
        machine.run("systemctl", "stop", NAME)
        assert (said("Result"), said("ExecMainStatus")) == ("success", "0")
        assert not (laboratory.state / kept.UP).exists()
        service("--remove")
        assert said("LoadState") == "not-found"
