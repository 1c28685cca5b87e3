"""The embedded cloud: the emulator with the project's own stacks in it, and PubNub's stand-in.

    with EmbeddedCloud(folder) as embedded:
        embedded.cloud.client("dynamodb")...

It writes below its folder only and stops on exit what it has started. Every socket listens on loopback;
with ``listen`` the two that robots need do so in a network, too.
"""

from __future__ import annotations

import os
import secrets
import signal
import ssl
import sys
import time
import urllib.request
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from types import TracebackType
from urllib.parse import urlsplit

from typing_extensions import Self

from iort_contract.cloud import PUBNUB
from iort_contract.limits import DEFAULT_NAMESPACE
from iort_station.cloud import EMBEDDED, Cloud, without_proxy
from iort_station.kept import LEDGER, announced
from iort_station.page.page import PubNubKeys, store_keys
from local import deployment
from local.deployment import ROOT, deploy
from local.emulator import package
from local.network.certificates import Authority, ServerCertificate
from local.network.servers import FileDoor, Listen, Relay
from local.persistence.ledger import settle
from local.processes import Child, EmulatorError, LocalError
from local.pubnub import PubNubStandIn
from local.state import StateFolder

FOLDER = ROOT / EMBEDDED.parent

_REGION = "eu-west-1"
_READY_S = 120.0
_POLL_S = 0.05
_END_S = 1.0
# The emulator's exit status when it cannot start, and says why.
_REFUSES = 1

Progress = Callable[[str], None]


class EmbeddedCloud:
    """One embedded cloud, from `__enter__` to `__exit__`.

    With ``live="iot"`` it has nothing of PubNub: no stand-in, no Lambda 1, neither `pubnub` nor `keys`.

    A ``kept`` cloud goes on from what its folder has, and what it acknowledges survives the end of its
    processes; with ``power_cut`` that of the machine, too. ``listen`` opens the broker and the files to a
    network. With ``journal`` the emulator writes its log to our own output. ``environment`` is added to the
    emulator's and its functions'.

    ``ports`` may set ``gateway``, ``mqtt``, ``pubnub``, ``relay`` and ``files``; the others are free ports. A
    kept cloud takes the usual ones if they are free, unless ``any_ports`` will do, and has them again.
    ``progress`` is called with the name of each step when it begins. `__enter__` raises `LocalError` if it
    cannot start. An error within the block is an `EmulatorError` if the emulator has ended.
    """

    host = "127.0.0.1"

    def __init__(
        self,
        folder: Path = FOLDER,
        *,
        namespace: str = DEFAULT_NAMESPACE,
        live: str = PUBNUB,
        ports: dict[str, int] | None = None,
        progress: Progress = lambda _step: None,
        kept: bool = False,
        any_ports: bool = False,
        power_cut: bool = False,
        listen: Listen | None = None,
        journal: bool = False,
        environment: Mapping[str, str] | None = None,
    ) -> None:
        self.folder, self.namespace = folder, namespace
        self.live, self.kept, self.listen = live, kept, listen
        self.state = StateFolder(folder, kept=kept, any_ports=any_ports)
        self.ports = ports or {}
        self.authority: Authority
        self.certificates: list[ServerCertificate] = []
        self.ledger = folder / LEDGER
        self.power_cut, self._journal = power_cut, journal
        self._environment = environment or {}
        self._progress = progress
        self._exit = ExitStack()
        self.cloud: Cloud
        self.pubnub: PubNubStandIn
        self.emulator: Child
        self.keys: PubNubKeys

    def __enter__(self) -> Self:
        with ExitStack() as stack:
            stack.push(self)
            self._start()
            stack.pop_all()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._exit.__exit__(kind, error, trace)

    def _start(self) -> None:
        began_ms = time.time_ns() // 1_000_000
        self.state.take(self._exit)
        without_proxy(self.host)
        self.ports = self._find_ports()
        self.authority = Authority(self.folder if self.kept else None)
        if self.authority.is_new and self.ledger.exists():
            self._progress("a new authority: every car needs a new bundle")
        # Only this machine reaches the gateway, and it reads its certificate once.
        certificate, key = self.authority.write(self.folder, "gateway", self.host)
        robots = self.listen.hosts if self.listen else ()
        broker = self.certificate("broker", tuple(dict.fromkeys([*robots, self.host, "localhost"])))
        self.cloud = Cloud(
            namespace=self.namespace,
            region=_REGION,
            endpoint_url=f"https://{self.host}:{self.ports['gateway']}",
            ca_bundle=str(certificate),
            access_key_id=f"AKIA{self.state.secret('owner.id', 8).upper()}",
            secret_access_key=self.state.secret("owner.key"),
            mqtt_host=self.listen.host if self.listen else self.host,
            mqtt_port=self.ports["mqtt"],
            root_ca_pem=self.authority.pem,
        )
        self._progress("emulator")
        self.start_emulator(certificate, key, broker)
        for name in ("gateway", "mqtt"):
            self.state.remember_port(name, self.ports[name])
        gateway = self.cloud.endpoint_url or ""
        relay = Relay(self.host, self.ports["relay"], gateway=gateway, authority=str(certificate))
        self.state.serve(self._exit, "relay", relay)
        self.cloud = replace(self.cloud, websocket=relay.url)
        if self.live == PUBNUB:
            self._start_pubnub(self.ports["pubnub"])
        deploy(self.cloud, self.folder, self._progress, live=self.live, kept=self.kept)
        if self.live == PUBNUB:
            store_keys(self.cloud, self.keys)
        self._progress("functions")
        deployment.warm_up(self.cloud, self.live)
        if self.kept:
            deployment.end_sessions(self.cloud, began_ms)
        if self.listen:
            door = FileDoor(
                self.listen.address,
                self.ports["files"],
                gateway=gateway,
                authority=certificate,
                bucket=self.cloud.output("storage", "FilesBucket"),
                certificate=self.certificate("files", self.listen.hosts),
            )
            self.state.serve(self._exit, "files", door)
        file = self.folder / EMBEDDED.name
        self.cloud.save(file)
        self._exit.callback(file.unlink, missing_ok=True)
        self._exit.enter_context(announced(file))

    def _find_ports(self) -> dict[str, int]:
        servers = ("gateway", "mqtt", "relay", *(["pubnub"] if self.live == PUBNUB else []))
        here: tuple[str, ...] = (self.host,)
        hosts = dict.fromkeys(servers, here)
        if self.listen:
            hosts |= {"mqtt": self._broker_hosts, "files": (self.listen.address,)}
        return {
            name: self.state.port(name, *there, wanted=self.ports.get(name, 0))
            for name, there in hosts.items()
        }

    @property
    def _broker_hosts(self) -> tuple[str, ...]:
        """Where the broker listens: also on loopback, for the robots of this machine."""
        return tuple(dict.fromkeys([*([self.listen.address] if self.listen else []), self.host]))

    def certificate(self, name: str, hosts: tuple[str, ...]) -> ServerCertificate:
        """A server's certificate, for as long as this cloud runs: see `renew`."""
        made = ServerCertificate(self.authority, self.folder / f"{name}.pem", hosts)
        made.renew()
        self.certificates.append(made)
        return made

    def show_page(self, url: str) -> None:
        """Tell the commands of this machine where the page is."""
        self.cloud = replace(self.cloud, page=url)
        self.cloud.save(self.folder / EMBEDDED.name)

    def renew(self) -> bool:
        """Renew the certificates that end soon; whether there was one. Servers notice a new file by
        themselves."""
        renewed = [one.renew() for one in self.certificates]
        return any(renewed)

    @property
    def files_url(self) -> str:
        """Where robots in the network store files and get answers."""
        listen = self.listen or Listen(self.host, (self.host,))
        return f"https://{listen.at(self.ports['files'])}"

    @property
    def page_ports(self) -> list[int]:
        """The ports that a page connects to, beside its server's."""
        relay = urlsplit(self.cloud.websocket_url).port or 0
        return [relay, self.pubnub.port] if self.live == PUBNUB else [relay]

    def _start_pubnub(self, port: int) -> None:
        self._progress("PubNub stand-in")
        publish_key, subscribe_key = (f"{kind}-c-{secrets.token_hex(8)}" for kind in ("pub", "sub"))
        self.pubnub = PubNubStandIn(self.host, port, publish_key=publish_key, subscribe_key=subscribe_key)
        self.pubnub.start()
        self._exit.callback(self.pubnub.stop)
        self.keys = PubNubKeys(
            publish_key=publish_key, subscribe_key=subscribe_key, origin=self.pubnub.origin, tls=False
        )

    def start_emulator(self, certificate: Path, key: Path, broker: ServerCertificate) -> None:
        """Start the emulator and wait until it is ready."""
        environment = {
            **self._environment,
            # Not our own environment: the functions would inherit the operator's credentials.
            "PATH": os.environ.get("PATH", os.defpath),
            "HOME": str(self.folder),
            "TMPDIR": str(self.folder / "tmp"),
            "STATE_DIR": str(self.folder / "state"),
            "S3_DATA_DIR": str(self.folder / "s3"),
            "AUTH": "true",
            "AWS_ACCESS_KEY_ID": self.cloud.access_key_id or "",
            "AWS_SECRET_ACCESS_KEY": self.cloud.secret_access_key or "",
            "BIND_HOST": self.host,
            "MINISTACK_HOST": self.host,
            "MINISTACK_REGION": _REGION,
            "GATEWAY_PORT": str(self.ports["gateway"]),
            "IOT_MTLS_PORT": str(self.ports["mqtt"]),
            "IOT_MTLS_HOST": ",".join(self._broker_hosts),
            "IORT_BROKER_CERTIFICATE": str(broker.path),
            **(self._kept_variables() if self.kept else {}),
            **({"ROBOTS_S3_ENDPOINT": self.files_url} if self.listen else {}),
            "SFTP_ENABLED": "0",
            "USE_SSL": "1",
            "MINISTACK_SSL_CERT": str(certificate),
            "MINISTACK_SSL_KEY": str(key),
            "AWS_CA_BUNDLE": str(certificate),
            # Its threads hold the interpreter's lock, and each arena of its own would keep what it once had.
            "MALLOC_ARENA_MAX": "1",
            # glibc raises these by itself; buffers of connections and batches then lie in the heap between
            # small objects, and it grows by 0.4 MB in each hour of five cars.
            "MALLOC_MMAP_THRESHOLD_": "65536",
            "MALLOC_TRIM_THRESHOLD_": "131072",
            "PYTHONPATH": str(package.folder()),
        }
        log = self.folder / "emulator.log"
        if self.kept and log.exists():
            # It may tell why the last one ended.
            log.replace(f"{log}.1")
        self.emulator = Child(
            "the emulator",
            [sys.executable, "-m", "local.emulator.run"],
            environment=environment,
            cwd=ROOT,
            log=None if self._journal else log,
            # What it must not lose is on the disk already, and its workers end with it.
            orphaned=signal.SIGKILL,
        )
        self._exit.push(self._end_emulator)
        for _ in range(int(_READY_S / _POLL_S)):
            self.emulator.check()
            try:
                self._get("/_ministack/ready")
            except OSError:
                # The emulator gives no other signal that it listens; on a slow machine it answers too late.
                self.emulator.wait(_POLL_S)
            else:
                return
        raise LocalError(f"the emulator was not ready after {_READY_S:.0f} s:\n{self.emulator.tail()}")

    def _end_emulator(
        self, _kind: type[BaseException] | None, error: BaseException | None, _trace: TracebackType | None
    ) -> None:
        # Its sockets close a moment before it has ended.
        status = self.emulator.wait(_END_S) if isinstance(error, Exception) else None
        self.emulator.kill()
        if self.kept:
            settle(self.ledger)
        if status not in {None, _REFUSES}:
            raise EmulatorError(self.emulator.ended()) from error

    def _kept_variables(self) -> dict[str, str]:
        return {
            "IORT_LEDGER": str(self.ledger),
            "IORT_LEDGER_SYNC": "full" if self.power_cut else "normal",
            # For weeks, at dozens of requests a second.
            "LOG_LEVEL": "WARNING",
        }

    def _get(self, path: str) -> bytes:
        context = ssl.create_default_context(cafile=self.cloud.ca_bundle)
        with urllib.request.urlopen(  # noqa: S310 - always https
            f"{self.cloud.endpoint_url}{path}", timeout=5, context=context
        ) as response:
            return bytes(response.read())
