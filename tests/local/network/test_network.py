"""`make up` on one machine and a car on another: what the network reaches, and what kills leave. Then systemd
runs the same cloud."""

from __future__ import annotations

import http.client
import os
import shutil
import signal
import ssl
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from urllib.parse import urlsplit

import pytest

from iort_station import kept
from iort_station.bridge.door import PROTOCOL
from iort_station.page.password import Password
from local.deployment import ROOT
from local.network.certificates import LASTS_S, Authority, ServerCertificate
from local.processes import Child
from local.up.commands import stop
from local.up.service import NAME
from testkit.namespaces import NoNamespacesError, two_machines
from testkit.waiting import GUARD_S, until
from tests.bridge.judge import Judge, bridging
from tests.local.network.booted import booted
from tests.local.network.laboratory import BIN, Laboratory, waiting

pytestmark = pytest.mark.heavy
HANDSHAKE = {
    "Connection": "Upgrade",
    "Upgrade": "websocket",
    "Sec-WebSocket-Version": "13",
    "Sec-WebSocket-Key": "dGhlIHNhbXBsZSBub25jZQ==",
    "Sec-WebSocket-Protocol": PROTOCOL,
}


@pytest.fixture(scope="module")
def laboratory(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Laboratory]:
    folder = tmp_path_factory.mktemp("laboratory")
    with ExitStack() as stack:
        try:
            cloud, car = stack.enter_context(two_machines(folder))
        except NoNamespacesError as error:
            pytest.skip(str(error))
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


def check(config: Path) -> list[str]:
    return [str(BIN / "iort-agent"), "check", "--config", str(config)]


def shows_the_ways(laboratory: Laboratory, bundle: Path) -> None:
    """`iort-agent check` on both machines; the car's configuration has the cloud's address in the network."""
    there = bundle / "car.yaml"
    way = laboratory.car.run(*check(there))
    assert f"route: from {laboratory.car.address} to {laboratory.cloud.address}" in way
    assert "rules: answer a ping" in way
    # A car of the cloud's own machine that was registered before LISTEN.
    here = bundle / "here.yaml"
    here.write_text(there.read_text().replace(laboratory.cloud.address, "127.0.0.1"))
    assert "rules: answer a ping" in laboratory.cloud.run(*check(here))


def is_well(laboratory: Laboratory, broker: str) -> None:
    """What `iort doctor` finds of a cloud that is up, without a car that is connected."""
    found = laboratory.findings(status=0)
    assert f"cars connect to {broker}" in found["servers"]["text"]
    assert found["robots"]["text"].startswith("0 of ")
    assert found["backup"]["text"].endswith(str(laboratory.backup))
    assert "recordings at most" in found["summaries"]["text"]
    assert {"memory", "load", "disk", "certificate of broker", "clock"} <= found.keys()


def is_whole_elsewhere(laboratory: Laboratory, bundle: Path, backed_up: int) -> None:
    """A backup that was made while the car drove, in another folder."""
    laboratory.iort("restore", str(laboratory.backup), state=laboratory.restored)
    with laboratory.running(state=laboratory.restored):
        assert laboratory.stored(laboratory.restored) >= backed_up
        # The car is known there, with its certificate.
        assert "accepts car1" in laboratory.car.run(*check(bundle / "car.yaml"))
        # Of a run that goes on elsewhere nobody knows the open batches.
        for one in laboratory.audited(laboratory.restored):
            assert (one["missing"], one["refused"]) == (0, 0)
            assert all(each["samples"] is None for each in one["shortfalls"])


def test_a_first_deployment_that_a_kill_interrupts_is_made_up_for(laboratory):
    log = laboratory.state / "cdk-deploy.log"
    with laboratory.running(ready=False):
        # The middle one of eight stacks.
        until(lambda: log.exists() and "processing: creating stack" in log.read_text(), within_s=400)
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
    deployed_ns = (laboratory.state / "cdk-deploy.log").stat().st_mtime_ns
    # What was opened stays open, and the ports are those of the bundle.
    with laboratory.running():
        # A second start deploys nothing, so that it is short.
        assert (laboratory.state / "cdk-deploy.log").stat().st_mtime_ns == deployed_ns
        assert laboratory.listeners() == reached
        # It is back by itself; the batches in between have waited in its queue.
        until(lambda: "online since" in laboratory.iort("robots", "list"))
        backed_up = laboratory.stored()
        assert "files" in laboratory.iort("backup", str(laboratory.backup))
        # It goes on.
        until(lambda: laboratory.stored() > backed_up + 50)
        refused = laboratory.iort("restore", str(laboratory.backup), "--force", status=1)
        assert "stop it first" in refused
        agent.interrupt()
        assert agent.wait(GUARD_S) == 0, agent.tail()
        until(lambda: "offline since" in laboratory.iort("robots", "list"))
        until(lambda: "vesc: complete" in laboratory.iort("audit", "car1"))
        upload = laboratory.folder / "drive.bag"
        upload.write_bytes(os.urandom(100_000))
        sent = car(bundle, "upload", str(upload))
        assert sent.wait(GUARD_S) == 0, sent.tail()
        assert "drive.bag" in laboratory.iort("files", "list", "car1")
        shows_the_ways(laboratory, bundle)
        is_well(laboratory, f"{address}:{ports['mqtt']}")
        assert stop(laboratory.state)
    assert laboratory.findings(status=1)["processes"]["level"] == "fail"
    assert laboratory.listeners() == set()
    ended = laboratory.car.run(*check(bundle / "car.yaml"), status=1)
    assert f"port: {address} answers, but nothing listens on {ports['mqtt']}" in ended
    is_whole_elsewhere(laboratory, bundle, backed_up)


def test_a_car_reaches_the_cloud_by_ipv6(laboratory, car):
    address = laboratory.cloud.address6
    bundle = laboratory.folder / "car6"
    with laboratory.running("--listen", address, "--page", f"{address},cloud.lab"):
        ports = kept.Up.load(laboratory.state).ports
        reached = {(address, ports[name]) for name in ("mqtt", "files", "network page")}
        assert laboratory.listeners() == reached
        laboratory.iort("robots", "add", "car6", "--out", str(laboratory.folder))
        assert "rules: answer a ping" in laboratory.car.run(*check(bundle / "car.yaml"))
        upload = laboratory.folder / "drive.bag"
        upload.write_bytes(b"samples")
        sent = car(bundle, "upload", str(upload))
        assert sent.wait(GUARD_S) == 0, sent.tail()
        assert "drive.bag" in laboratory.iort("files", "list", "car6")
        assert f"cars connect to [{address}]:{ports['mqtt']}" in laboratory.iort("doctor")


def test_a_tool_elsewhere_needs_the_authority_and_the_password_of_the_page(laboratory, car):
    """`iort bridge --listen` takes the page's certificate by itself, and takes over a renewed one."""
    address, authority = laboratory.cloud.address, laboratory.state / "authority.pem"
    with laboratory.running("--listen", address, "--page", address):
        known = ssl.create_default_context(cafile=authority)
        Password(laboratory.state).set("correct horse")
        laboratory.iort("robots", "add", "car7", "--out", str(laboratory.folder))
        car(laboratory.folder / "car7", "run")
        until(lambda: "vesc" in laboratory.iort("streams", "car7"))
        iort = [str(BIN / "iort"), "bridge", "car7", "--listen", address, "--port", "0", "--json"]
        with bridging(laboratory.cloud.command(*iort), laboratory.environment()) as served:
            url = urlsplit(served["url"])
            assert (url.scheme, url.hostname, url.query) == ("wss", address, "key=PASSWORD")
            assert (address, url.port) in laboratory.listeners()

            def answer(query: str, trusts: ssl.SSLContext = known) -> tuple[int, str, str]:
                """What a client on the car's machine gets: status, words, and the certificate's number."""
                way = http.client.HTTPConnection(address, url.port)
                with laboratory.car.socket() as plain:
                    plain.settimeout(GUARD_S)
                    plain.connect((address, url.port))
                    with trusts.wrap_socket(plain, server_hostname=address) as way.sock:
                        number = way.sock.getpeercert()["serialNumber"]
                        way.request("GET", f"/?{query}", headers=HANDSHAKE)
                        told = way.getresponse()
                        words = "" if told.status == 101 else told.read().decode().strip()
                        return told.status, words, number

            refusal = 401, "the address must end in /?key= and the password"
            for query in ("", "key=", "key=PASSWORD", "key=correct%20hors"):
                assert answer(query)[:2] == refusal, query
            right = "key=correct%20horse"
            status, _, first = answer(right)
            assert status == 101
            # Who does not know the authority sends no password.
            with pytest.raises(ssl.SSLCertVerificationError):
                answer(right, ssl.create_default_context())
            with Judge(
                url._replace(query=right).geturl(), within=laboratory.car.command(), authority=authority
            ) as judge:
                judge.do("subscribe", topic="/iort/vesc")
                seen = until(lambda: list(judge.got("/iort/vesc")))
                assert "voltage_input" in seen[0].fields
            # As after two months.
            page = ServerCertificate(
                Authority(laboratory.state), laboratory.state / "page.pem", (address,), renewed_s=LASTS_S
            )
            assert page.renew()
            # The first connection after the change tells the server.
            assert [answer(right)[2] == first for _ in range(2)] == [True, False]


def test_systemd_starts_the_cloud_again_after_a_kill_and_stops_it(laboratory):
    def service(*options: str) -> None:
        machine.run(sys.executable, "-m", "local.up.service", "--state", str(state), *options)

    def said(key: str) -> str:
        return machine.run("systemctl", "show", NAME, "--property", key, "--value").strip()

    # What is mounted in a namespace is not there.
    state = shutil.copytree(laboratory.state, laboratory.folder / "service")
    with booted(laboratory.folder) as machine:
        service("--listen", "127.0.0.5,iort.lab", "--page", "no")
        # Starting it ends when it is ready.
        assert (said("ActiveState"), said("UnitFileState")) == ("active", "enabled")
        main = said("MainPID")
        machine.run("kill", "-KILL", main)
        until(lambda: said("ActiveState") == "active" and said("MainPID") not in {"0", main})
        assert said("NRestarts") == "1"
        doctor = machine.run(str(BIN / "iort"), "doctor", IORT_STATE=str(state))
        assert f"processes: up {said('MainPID')}, emulator " in doctor
        assert "ok    servers: all answer" in doctor
        assert "connect to iort.lab:" in machine.run("journalctl", "--identifier", "iort-cloud")
        machine.run("systemctl", "stop", NAME)
        assert (said("Result"), said("ExecMainStatus")) == ("success", "0")
        assert not (state / kept.UP).exists()
        service("--remove")
        assert said("LoadState") == "not-found"
