"""Certificates for servers on this machine: queues refuse plain HTTP, and robots refuse plain MQTT."""

from __future__ import annotations

import ipaddress
import ssl
from collections.abc import Iterable
from dataclasses import dataclass
from datetime import datetime, timedelta, timezone
from pathlib import Path, PurePath

import trustme
from cryptography import x509
from cryptography.exceptions import InvalidSignature
from cryptography.hazmat.primitives.serialization import load_pem_private_key

from iort_agent.common.private_files import write_below
from local.processes import LocalError

# A server's certificate in the network, and what is left of it when it gets a new one.
LASTS_S = 90 * 86_400.0
RENEWED_S = 30 * 86_400.0


def _write(path: Path, content: bytes) -> None:
    """A file for its owner alone. The robot's tests have no station, whose writer would do."""
    write_below(path.parent, PurePath(path.name), content, sync=True)


class Authority:
    """Signs certificates that nobody trusts unless told to. With a ``folder`` it is kept there; raises
    `LocalError` if it is damaged there."""

    def __init__(self, folder: Path | None = None) -> None:
        own, key = ((folder or Path()) / f"authority.{kind}" for kind in ("pem", "key"))
        self.is_new = folder is None or not (own.exists() or key.exists())
        if not self.is_new:
            self._authority = _read_authority(own, key)
            return
        self._authority = trustme.CA(organization_name="iort", organization_unit_name="this machine")
        if folder is not None:
            _write(own, self.pem.encode())
            _write(key, self._authority.private_key_pem.bytes())

    @property
    def pem(self) -> str:
        """The authority's own certificate, which its clients trust."""
        return self._authority.cert_pem.bytes().decode()

    def write(self, folder: Path, name: str, *hosts: str) -> tuple[Path, Path]:
        """Write ``<name>.pem`` and ``<name>.key`` for IP addresses and names, and return their paths.

        The authority's certificate is behind the other one, so that clients may trust the same file. Only the
        owner may read the key.
        """
        leaf = self.issue(name, *hosts)
        certificate_path, key_path = folder / f"{name}.pem", folder / f"{name}.key"
        certificate_path.write_bytes(leaf.cert_chain_pems[0].bytes() + self.pem.encode())
        _write(key_path, leaf.private_key_pem.bytes())
        return certificate_path, key_path

    def issue(self, name: str, *hosts: str, lasts_s: float | None = None) -> trustme.LeafCert:
        """A certificate for IP addresses and names; it ends after ``lasts_s``, or in a thousand years."""
        end = None if lasts_s is None else datetime.now(timezone.utc) + timedelta(seconds=lasts_s)
        return self._authority.issue_cert(*hosts, common_name=name, not_after=end)

    def signed(self, certificate: x509.Certificate) -> bool:
        """Whether this authority has signed a certificate."""
        own = x509.load_pem_x509_certificate(self.pem.encode())
        try:
            certificate.verify_directly_issued_by(own)
        except (ValueError, TypeError, InvalidSignature):
            return False
        return True


def _read_authority(own: Path, key: Path) -> trustme.CA:
    try:
        texts = own.read_bytes(), key.read_bytes()
        public = load_pem_private_key(texts[1], None).public_key()
        wrong = "" if x509.load_pem_x509_certificate(texts[0]).public_key() == public else "another's key"
    except (FileNotFoundError, ValueError, TypeError) as error:
        wrong = str(error)
    if wrong:
        raise LocalError(
            f"{own} and {key.name} must be the certificate that the cars trust and its key, got {wrong}: "
            "`iort restore` a backup, or remove both, and then each car needs a new bundle"
        )
    return trustme.CA.from_pem(*texts)


@dataclass(frozen=True)
class ServerCertificate:
    """A file with a server's key and certificate, for the hosts by which clients reach the server."""

    authority: Authority
    path: Path
    hosts: tuple[str, ...]
    lasts_s: float = LASTS_S
    renewed_s: float = RENEWED_S

    @property
    def name(self) -> str:
        """The server's name."""
        return self.path.stem

    def ends_s(self) -> float:
        """When it ends, since the epoch."""
        return self._read().not_valid_after_utc.timestamp()

    def renew(self) -> bool:
        """Write a certificate if there is none, if it ends soon, or if it is for other hosts; whether it
        did."""
        if self.path.exists() and self._good():
            return False
        leaf = self.authority.issue(self.name, *self.hosts, lasts_s=self.lasts_s)
        _write(self.path, leaf.private_key_and_cert_chain_pem.bytes() + self.authority.pem.encode())
        return True

    def context(self) -> ssl.SSLContext:
        """A server's context, which takes over a renewed certificate by itself."""
        from iort_station.page.background import tls_context  # noqa: PLC0415 - the robot's tests have no station

        return tls_context(self.path)

    def _good(self) -> bool:
        try:
            there = self._read()
            names = there.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
        except (ValueError, x509.ExtensionNotFound):
            return False
        hosts = {str(one.value) for one in names}
        left_s = there.not_valid_after_utc.timestamp() - datetime.now(timezone.utc).timestamp()
        return hosts == set(self.hosts) and left_s > self.renewed_s and self.authority.signed(there)

    def _read(self) -> x509.Certificate:
        return x509.load_pem_x509_certificate(self.path.read_bytes())


def is_address(host: str) -> bool:
    """Whether a host is an IP address, and not a name."""
    try:
        ipaddress.ip_address(host)
    except ValueError:
        return False
    return True


def spelled(hosts: Iterable[str]) -> tuple[str, ...]:
    """Hosts in their one spelling, each once."""
    return tuple(
        dict.fromkeys(str(ipaddress.ip_address(one)) if is_address(one) else one.lower() for one in hosts)
    )
