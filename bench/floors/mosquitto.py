"""Debian's mosquitto with mutual TLS: the floor of a broker, written in C.

It only passes messages on: it has no rules, tables or policies."""

from __future__ import annotations

import shutil
import socket
import subprocess
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path

import yaml
from awsiot import mqtt5_client_builder
from typing_extensions import Self

from local.network.certificates import Authority
from testkit.mqtt import Client
from testkit.waiting import InstrumentError

HOST = "127.0.0.1"
# The robot that `Mosquitto.car` configures.
ROBOT = "bench"
_START_S = 20.0
# Messages leave at once, as they do from AWS IoT Core and the agent.
_SETTINGS = """
listener {port} {host}
cafile {folder}/ca.pem
certfile {folder}/broker.pem
keyfile {folder}/broker.key
require_certificate true
use_identity_as_username true
set_tcp_nodelay true
persistence false
log_type error
"""


def found() -> str | None:
    """Return the path of mosquitto, if it is installed; Debian keeps it out of a user's PATH."""
    return shutil.which("mosquitto") or shutil.which("mosquitto", path="/usr/sbin")


class Mosquitto:
    """The broker from `__enter__` to `__exit__`; `identity` makes certificates that it accepts.

    Raises `InstrumentError` where it does not start.
    """

    def __init__(self, program: str, folder: Path) -> None:
        self._program, self._folder = program, folder
        self._authority = Authority()
        with socket.socket() as probe:
            probe.bind((HOST, 0))
            self.port = int(probe.getsockname()[1])

    @property
    def ca(self) -> Path:
        """The certificate of the authority that signed all others."""
        return self._folder / "ca.pem"

    def __enter__(self) -> Self:
        self.ca.write_text(self._authority.pem)
        self.identity("broker")
        config = self._folder / "mosquitto.conf"
        config.write_text(_SETTINGS.format(port=self.port, host=HOST, folder=self._folder))
        # As root, mosquitto would switch to the user mosquitto, who may not read the keys.
        with config.open("a") as file:
            file.write("user root\n")
        with (self._folder / "mosquitto.log").open("w") as log:
            self._process = subprocess.Popen([self._program, "-c", config], stdout=log, stderr=log)
        deadline = time.monotonic() + _START_S
        while True:
            try:
                socket.create_connection((HOST, self.port)).close()
            except OSError as error:
                if self._process.poll() is not None or time.monotonic() > deadline:
                    said = (self._folder / "mosquitto.log").read_text()
                    raise InstrumentError(f"mosquitto does not start: {said}") from error
                time.sleep(0.02)  # mosquitto does not report when it listens
            else:
                return self

    def __exit__(self, *_: object) -> None:
        self._process.terminate()
        self._process.wait()

    def identity(self, name: str) -> tuple[Path, Path]:
        """A new certificate and its key, as files."""
        return self._authority.write(self._folder, name, HOST)

    def car(
        self, topics: Mapping[str, Mapping[str, str]], source: str = "ros1", *, live: str = "always"
    ) -> Path:
        """Write and return the configuration of an agent that subscribes to these topics. ``live`` says when
        it sends live messages: nobody holds a lease here."""
        certificate, key = self.identity(ROBOT)
        settings = {
            "robot": ROBOT,
            "endpoint": HOST,
            "port": self.port,
            "certificate": str(certificate),
            "private_key": str(key),
            "root_ca": str(self.ca),
            "sources": [{"type": source, "topics": {name: dict(one) for name, one in topics.items()}}],
            "queue": {"path": "spool.db"},
            "live": {"when": live},
        }
        config = self._folder / "car.yaml"
        config.write_text(yaml.safe_dump(settings))
        return config


NAME = "bench-watcher"


@contextmanager
def subscribed(
    broker: Mosquitto, topic_filters: Sequence[str], take: Callable[[str, bytes], None], *, qos: int = 0
) -> Iterator[None]:
    """Call ``take`` with topic and payload of every message, in the client's thread."""
    certificate, key = broker.identity("watcher")
    build = partial(
        mqtt5_client_builder.mtls_from_path,
        str(certificate),
        str(key),
        endpoint=HOST,
        port=broker.port,
        ca_filepath=str(broker.ca),
        client_id=NAME,
    )
    with Client(NAME, build, take) as client:
        client.online()
        for topic_filter in topic_filters:
            client.subscribe(topic_filter, qos)
        yield
