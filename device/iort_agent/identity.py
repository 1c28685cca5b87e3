"""Reads a certificate file: its id at AWS, its validity, and whether a private key belongs to it.

The running agent needs only the id, which the standard library computes. The validity needs the library
cryptography, which takes 0.1 s to load and 17 MB of memory, so it is loaded on first use.
"""

from __future__ import annotations

import hashlib
import re
import ssl
import warnings
from pathlib import Path
from typing import Any, NamedTuple, Optional, Tuple

from iort_agent.errors import IdentityError

_PEM = re.compile(r"-----BEGIN CERTIFICATE-----\s+.+?-----END CERTIFICATE-----", re.DOTALL)
_KEY = re.compile(r"-----BEGIN [A-Z ]*PRIVATE KEY-----")

# Change time, size and inode of each file; None for a file that is missing.
Stamp = Tuple[Optional[Tuple[int, int, int]], ...]


class Validity(NamedTuple):
    """The first and the last second of a certificate, since the epoch."""

    not_before_s: int
    not_after_s: int


class Certificate(NamedTuple):
    """A certificate in DER. Only `validity` checks more than its PEM armour."""

    der: bytes

    @property
    def id(self) -> str:
        """AWS' id of the certificate: the SHA-256 of its DER."""
        return hashlib.sha256(self.der).hexdigest()

    def validity(self) -> Validity:
        """The validity. Raises `IdentityError` if this is no X.509 certificate."""
        read = self._read()
        first, last = read.not_valid_before_utc, read.not_valid_after_utc
        return Validity(int(first.timestamp()), int(last.timestamp()))

    def names(self) -> list[str]:
        """The host names and addresses of a server's certificate. Raises `IdentityError` as `validity`."""
        x509, read = load_x509(), self._read()
        try:
            extension = read.extensions.get_extension_for_class(x509.SubjectAlternativeName)
        except (x509.ExtensionNotFound, ValueError):
            return []
        return [str(name.value) for name in extension.value]

    def issuer(self) -> str:
        """Who signed it. Raises `IdentityError` as `validity`."""
        return str(self._read().issuer.rfc4514_string())

    def _read(self) -> Any:
        try:
            return load_x509().load_der_x509_certificate(self.der)
        except ValueError as error:
            raise IdentityError(f"is not an X.509 certificate: {error}") from error


def load_x509() -> Any:
    """Load the module cryptography.x509. Raises `IdentityError` if it cannot be loaded."""
    try:
        with warnings.catch_warnings():
            # On Python 3.8 it warns that this Python is old, which the user cannot change.
            warnings.simplefilter("ignore")
            from cryptography import x509  # noqa: PLC0415 - see the module's text
    except ImportError as error:
        raise IdentityError(f"the Python package cryptography cannot be loaded: {error}") from error
    return x509


def read_certificate(path: Path) -> Certificate:
    """Read the first certificate of a PEM file. Raises `IdentityError` if there is none."""
    try:
        return parse_certificate(path.read_text(encoding="ascii", errors="replace"))
    except OSError as error:
        raise IdentityError(f"{path}: cannot be read: {error.strerror}") from error
    except IdentityError as error:
        raise IdentityError(f"{path}: {error}") from error


def parse_certificate(pem: str) -> Certificate:
    """Parse the first certificate of a PEM text. Raises `IdentityError` if there is none."""
    match = _PEM.search(pem)
    if match is None:
        raise IdentityError("holds no PEM certificate")
    try:
        return Certificate(ssl.PEM_cert_to_DER_cert(match[0]))
    except ValueError as error:
        raise IdentityError(f"is not an X.509 certificate: {error}") from error


def check_pair(certificate: Path, private_key: Path) -> None:
    """Raise `IdentityError` if a file cannot be read or is not what its name says, if the key is not the
    certificate's, or if it needs a password."""
    for path, other, what, content in (
        (certificate, private_key, "certificate", _PEM),
        (private_key, certificate, "private_key", _KEY),
    ):
        if not _holds(path, content):
            swapped = f", and {other.name} has one: are the two swapped?" if _holds(other, content) else ""
            raise IdentityError(f"{what}: {path} holds no PEM {what.replace('_', ' ')}{swapped}")
    try:
        # A password is never asked for: this may run without a terminal.
        ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT).load_cert_chain(
            certificate, private_key, password=_no_password
        )
    except (OSError, ValueError) as error:
        reason = getattr(error, "reason", None) or getattr(error, "strerror", None) or error
        if "MISMATCH" in str(reason):
            raise IdentityError(f"{private_key} is not the key of {certificate}") from error
        raise IdentityError(f"{certificate} and {private_key} cannot be used: {reason}") from error


def _holds(path: Path, content: re.Pattern[str]) -> bool:
    try:
        return content.search(path.read_text(encoding="ascii", errors="replace")) is not None
    except OSError as error:
        raise IdentityError(f"{path}: cannot be read: {error.strerror}") from error


def stamp(*paths: Path | None) -> Stamp:
    """The stamp of the files: it changes when one of them is written, replaced or removed."""
    return tuple(_stamp(path) for path in paths if path is not None)


def _stamp(path: Path) -> tuple[int, int, int] | None:
    try:
        status = path.stat()
    except OSError:
        return None
    return status.st_mtime_ns, status.st_size, status.st_ino


def _no_password() -> str:
    raise ValueError("the key needs a password, which the agent does not ask for")
