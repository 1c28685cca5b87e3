"""Debian's mosquitto with mutual TLS, as a second broker: what a broker in C leaves for the agent to spend.

It only passes messages on: there are no rules, no tables and no policies behind it.
"""

from __future__ import annotations

import datetime as dt
import ipaddress
import shutil
import socket
import subprocess
import time
from pathlib import Path
from types import TracebackType

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import NameOID
from typing_extensions import Self

HOST = "127.0.0.1"
_START_S = 20.0
_NAME = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, "iort bench")])
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
    """Where mosquitto is, if it is installed; Debian keeps it out of a user's path."""
    return shutil.which("mosquitto") or shutil.which("mosquitto", path="/usr/sbin")


class Mosquitto:
    """The broker from `__enter__` to `__exit__`; `identity` makes certificates that it accepts.

    Raises `OSError` where it does not start.
    """

    def __init__(self, program: str, folder: Path) -> None:
        self._program, self._folder = program, folder
        self._key = ec.generate_private_key(ec.SECP256R1())
        with socket.socket() as probe:
            probe.bind((HOST, 0))
            self.port = int(probe.getsockname()[1])

    @property
    def ca(self) -> Path:
        """The certificate of the authority that signed all others."""
        return self._folder / "ca.pem"

    def __enter__(self) -> Self:
        self._write("ca", self._key, authority=True)
        self.identity("broker")
        config = self._folder / "mosquitto.conf"
        config.write_text(_SETTINGS.format(port=self.port, host=HOST, folder=self._folder))
        # Started by root it would become the user mosquitto, who may not read the keys.
        with config.open("a") as file:
            file.write("user root\n")
        log = (self._folder / "mosquitto.log").open("w")
        self._process = subprocess.Popen([self._program, "-c", config], stdout=log, stderr=log)
        deadline = time.monotonic() + _START_S
        while True:
            try:
                socket.create_connection((HOST, self.port)).close()
            except OSError as error:
                if self._process.poll() is not None or time.monotonic() > deadline:
                    said = (self._folder / "mosquitto.log").read_text()
                    raise OSError(f"mosquitto does not start: {said}") from error
                time.sleep(0.02)  # it has no other way to tell that it listens
            else:
                return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._process.terminate()
        self._process.wait()

    def identity(self, name: str) -> tuple[Path, Path]:
        """A new certificate and its key, as files."""
        key = ec.generate_private_key(ec.SECP256R1())
        return self._write(name, key, authority=False)

    def _write(self, name: str, key: ec.EllipticCurvePrivateKey, *, authority: bool) -> tuple[Path, Path]:
        now = dt.datetime.now(dt.timezone.utc)
        subject = _NAME if authority else x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)])
        address = x509.IPAddress(ipaddress.ip_address(HOST))
        made = (
            x509.CertificateBuilder()
            .subject_name(subject)
            .issuer_name(_NAME)
            .public_key(key.public_key())
            .serial_number(x509.random_serial_number())
            .not_valid_before(now - dt.timedelta(days=1))
            .not_valid_after(now + dt.timedelta(days=2))
            .add_extension(x509.BasicConstraints(ca=authority, path_length=None), critical=True)
            .add_extension(x509.SubjectAlternativeName([address]), critical=False)
            .sign(self._key, hashes.SHA256())
        )
        certificate_file, key_file = self._folder / f"{name}.pem", self._folder / f"{name}.key"
        certificate_file.write_bytes(made.public_bytes(serialization.Encoding.PEM))
        key_file.touch(mode=0o600)
        key_file.write_bytes(
            key.private_bytes(
                serialization.Encoding.PEM,
                # The agent's TLS library reads keys of elliptic curves in their own format.
                serialization.PrivateFormat.TraditionalOpenSSL,
                serialization.NoEncryption(),
            )
        )
        return certificate_file, key_file
