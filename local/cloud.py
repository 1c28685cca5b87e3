"""The embedded cloud: the emulator with the project's own stacks in it, and PubNub's stand-in.

    with EmbeddedCloud(folder) as embedded:
        embedded.cloud.client("dynamodb")...

It writes below its folder only and stops on exit what it has started. Every socket listens on loopback,
unless the caller gives another host.
"""

from __future__ import annotations

import errno
import fcntl
import json
import os
import secrets
import shutil
import signal
import socket
import ssl
import sys
import urllib.error
import urllib.request
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from types import TracebackType
from typing import Any
from urllib.parse import urlsplit

from typing_extensions import Self

from iort_contract.cloud import PUBNUB
from iort_contract.limits import DEFAULT_NAMESPACE
from iort_contract.messages.event import rule_event
from iort_contract.messages.live import LiveSample, encode_live, encode_ping
from iort_contract.topics import FILE, LAMBDA, LIVE, PING, build_topic
from iort_station.cloud import EMBEDDED, Cloud, without_proxy
from iort_station.page import keys
from iort_station.page.keys import PubNubKeys
from local import patched
from local.certificates import Authority
from local.deployment import ROOT, deploy
from local.errors import LocalError
from local.processes import Child
from local.pubnub.standin import PubNubStandIn
from local.relay import Relay

FOLDER = ROOT / EMBEDDED.parent

_REGION = "eu-west-1"
_LEAST_FREE_BYTES = 500 * 1024 * 1024
_READY_S = 120.0
_POLL_S = 0.05

Progress = Callable[[str], None]


class EmbeddedCloud:
    """One embedded cloud, from `__enter__` to `__exit__`.

    With ``live="iot"`` it has nothing of PubNub: no stand-in, no Lambda 1, neither `pubnub` nor `keys`.

    ``ports`` may set ``gateway``, ``mqtt``, ``pubnub`` and ``relay``; the others are free ports. ``progress``
    is called with the name of each step when it begins. `__enter__` raises `LocalError` if it cannot start.
    """

    def __init__(
        self,
        folder: Path = FOLDER,
        *,
        namespace: str = DEFAULT_NAMESPACE,
        live: str = PUBNUB,
        host: str = "127.0.0.1",
        ports: dict[str, int] | None = None,
        progress: Progress = lambda _step: None,
    ) -> None:
        self.folder, self.namespace, self.host = folder, namespace, host
        self.live = live
        self._ports, self._progress = ports or {}, progress
        self._exit = ExitStack()
        self.cloud: Cloud
        self.pubnub: PubNubStandIn
        self.emulator: Child
        self.keys: PubNubKeys

    def __enter__(self) -> Self:
        try:
            self._start()
        except BaseException:
            self._exit.close()
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._exit.close()

    def _start(self) -> None:
        self._take_folder()
        without_proxy(self.host)
        ports = {name: self._port(name) for name in ("gateway", "mqtt", "pubnub", "relay")}
        certificate, key = Authority().write(self.folder, "gateway", self.host)
        self.cloud = Cloud(
            namespace=self.namespace,
            region=_REGION,
            endpoint_url=f"https://{self.host}:{ports['gateway']}",
            ca_bundle=str(certificate),
            access_key_id="test",
            secret_access_key="test",  # noqa: S106 - the emulator's name for its root user
            mqtt_host=self.host,
            mqtt_port=ports["mqtt"],
        )
        self._progress("emulator")
        self.start_emulator(certificate, key)
        root_ca = self._get("/_ministack/iot/ca.pem").decode()
        # Robots also send files to the gateway, which has a certificate of its own.
        self.cloud = replace(self.cloud, root_ca_pem=root_ca + certificate.read_text())
        gateway = self.cloud.endpoint_url or ""
        relay = Relay(self.host, ports["relay"], gateway=gateway, authority=str(certificate))
        self._exit.enter_context(relay)
        self.cloud = replace(self.cloud, websocket=relay.url)
        if self.live == PUBNUB:
            self._start_pubnub(ports["pubnub"])
        deploy(self.cloud, self.folder, self._progress, live=self.live)
        if self.live == PUBNUB:
            keys.store(self.cloud, self.keys)
        self._warm_up()
        self.cloud.save(self.folder / EMBEDDED.name)
        self._exit.callback((self.folder / EMBEDDED.name).unlink, missing_ok=True)

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

    def _take_folder(self) -> None:
        self.folder.mkdir(parents=True, exist_ok=True)
        if shutil.disk_usage(self.folder).free < _LEAST_FREE_BYTES:
            raise LocalError(f"{self.folder} must have {_LEAST_FREE_BYTES // 2**20} MB free: free some space")
        # The file stays open and locked while this cloud runs.
        lock = self._exit.enter_context((self.folder.parent / f"{self.folder.name}.lock").open("a+"))
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            lock.seek(0)
            owner = lock.read().strip()
            raise LocalError(
                f"an embedded cloud is already running in {self.folder} (process {owner}): "
                f"use it, or stop it with Ctrl-C in its terminal or `kill {owner}`"
            ) from error
        lock.truncate(0)
        lock.write(str(os.getpid()))
        lock.flush()
        # Files of an earlier run remain after a kill -9.
        shutil.rmtree(self.folder)
        (self.folder / "tmp").mkdir(parents=True, mode=0o700)

    def _port(self, name: str) -> int:
        wanted = self._ports.get(name, 0)
        with socket.socket() as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                probe.bind((self.host, wanted))
            except OSError as error:
                if error.errno == errno.EADDRINUSE:
                    raise LocalError(f"port {wanted} ({name}) is in use: give another, or none") from error
                raise LocalError(f"cannot listen on {self.host}:{wanted} ({name}): {error}") from error
            return int(probe.getsockname()[1])

    def start_emulator(self, certificate: Path, key: Path) -> None:
        """Start the emulator and wait until it is ready."""
        gateway = (self.cloud.endpoint_url or "").rsplit(":", 1)[-1]
        environment = {
            # Not our own environment: the functions would inherit the operator's credentials.
            "PATH": os.environ.get("PATH", os.defpath),
            "HOME": str(self.folder),
            "TMPDIR": str(self.folder / "tmp"),
            "STATE_DIR": str(self.folder / "state"),
            "S3_DATA_DIR": str(self.folder / "s3"),
            "AUTH": "true",
            "BIND_HOST": self.host,
            "MINISTACK_HOST": self.host,
            "MINISTACK_REGION": _REGION,
            "GATEWAY_PORT": gateway,
            "IOT_MTLS_PORT": str(self.cloud.mqtt_port),
            "SFTP_ENABLED": "0",
            "USE_SSL": "1",
            "MINISTACK_SSL_CERT": str(certificate),
            "MINISTACK_SSL_KEY": str(key),
            "AWS_CA_BUNDLE": str(certificate),
            "PYTHONDONTWRITEBYTECODE": "1",
            "PYTHONPATH": str(patched.folder()),
        }
        self.emulator = Child(
            "the emulator",
            [sys.executable, "-m", "local.emulator"],
            environment=environment,
            cwd=ROOT,
            log=self.folder / "emulator.log",
            # It has no state to save, and its workers end with it.
            orphaned=signal.SIGKILL,
        )
        self._exit.callback(self.emulator.kill)
        for _ in range(int(_READY_S / _POLL_S)):
            self.emulator.check()
            try:
                self._get("/_ministack/ready")
            except (urllib.error.URLError, ConnectionError):
                # The emulator gives no other signal that it listens.
                self.emulator.wait(_POLL_S)
            else:
                return
        raise LocalError(f"the emulator was not ready after {_READY_S:.0f} s:\n{self.emulator.tail()}")

    def _get(self, path: str) -> bytes:
        context = ssl.create_default_context(cafile=self.cloud.ca_bundle)
        with urllib.request.urlopen(  # noqa: S310 - always https
            f"{self.cloud.endpoint_url}{path}", timeout=5, context=context
        ) as response:
            return bytes(response.read())

    def _warm_up(self) -> None:
        """Invoke every function once, with an event that has no effect.

        A first invocation takes seconds on a small machine, and a live message that waits for it is stale.
        """
        self._progress("functions")
        # A sample of 1970 is stale and is dropped.
        stale = LiveSample(boot="00000000", seq=0, t_us=0, sent_us=0, sample={}, offset_us=0)
        warm_up: dict[tuple[str, str], dict[str, Any]] = {
            ("processing", "Live"): self._rule_event(encode_live(stale), LIVE, "warm-up"),
            ("processing", "Summarize"): {"Records": []},
            ("processing", "Echo"): self._rule_event(encode_ping(0, 0), PING, LAMBDA),
            # An event without a fault and without a low voltage.
            ("processing", "Alert"): self._rule_event(b"", LIVE, "warm-up"),
            # Refused without a listener. Without an id it would go to quarantine.
            ("processing", "Upload"): self._rule_event(b'{"id": "00000000"}', PING, FILE),
            ("fleet", "Admit"): {},
            ("fleet", "Presence"): {},
            ("processing", "Query"): {},
        }
        if self.live != PUBNUB:
            del warm_up["processing", "Live"]
        client = self.cloud.client("lambda")
        for (stack, name), event in warm_up.items():
            function = self.cloud.output(stack, f"{name}Function")
            answer = client.invoke(FunctionName=function, Payload=json.dumps(event).encode())
            if "FunctionError" in answer:
                reason = answer["Payload"].read().decode(errors="replace")
                raise LocalError(f"function {name} does not start: {reason[:500]}")

    def _rule_event(self, message: bytes, lane: str, name: str) -> dict[str, Any]:
        return rule_event(message, build_topic(lane, "warm-up", name, self.namespace), 0)
