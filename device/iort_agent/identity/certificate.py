"""What a certificate file says, read with the standard library alone.

Of an X.509 certificate the agent needs its number at AWS (the SHA-256 of its DER), until when it is
valid, and whether a private key is its own.
"""

from __future__ import annotations

import binascii
import calendar
import hashlib
import re
import ssl
import time
from pathlib import Path
from typing import NamedTuple, Optional, Tuple

from iort_agent.errors import IdentityError

_PEM = re.compile(r"-----BEGIN CERTIFICATE-----\s+(.+?)-----END CERTIFICATE-----", re.DOTALL)
_SEQUENCE, _VERSION, _UTC_TIME, _GENERALIZED_TIME = 0x30, 0xA0, 0x17, 0x18

# What tells one content of a file from the next: change time, size, inode; None where there is none.
Stamp = Tuple[Optional[Tuple[int, int, int]], ...]


class Certificate(NamedTuple):
    """``id`` is what AWS calls the certificate; the times are seconds since the epoch."""

    id: str
    not_before_s: int
    not_after_s: int


def read_certificate(path: Path) -> Certificate:
    """The first certificate of a PEM file; raises `IdentityError` where there is none."""
    try:
        return parse_certificate(path.read_text(encoding="ascii", errors="replace"))
    except OSError as error:
        raise IdentityError(f"{path}: cannot be read: {error.strerror}") from error
    except IdentityError as error:
        raise IdentityError(f"{path}: {error}") from error


def parse_certificate(pem: str) -> Certificate:
    """The first certificate of a PEM text; raises `IdentityError` where there is none."""
    found = _PEM.search(pem)
    if found is None:
        raise IdentityError("holds no PEM certificate")
    try:
        der = binascii.a2b_base64("".join(found[1].split()))
        # Certificate ::= SEQUENCE { tbs SEQUENCE { [0] version?, serial, signature, issuer, validity
        _, body, _ = _element(der, 0)
        _, at, end = _element(der, body)
        kind, _, after = _element(der, at)
        if kind == _VERSION:
            at = after
        for _ in range(3):
            _, _, at = _element(der, at)
        kind, at, validity_end = _element(der, at)
        if kind != _SEQUENCE or validity_end > end:
            raise IdentityError("is not an X.509 certificate")
        not_before_s, at = _time(der, at)
        not_after_s, _ = _time(der, at)
    except (ValueError, IndexError) as error:
        raise IdentityError(f"is not an X.509 certificate: {error}") from error
    return Certificate(hashlib.sha256(der).hexdigest(), not_before_s, not_after_s)


def check_pair(certificate: Path, private_key: Path) -> None:
    """Raise `IdentityError` where the key is not the certificate's, or needs a password."""
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


def stamp(*paths: Path | None) -> Stamp:
    """Differs when one of the files was written, replaced or removed."""
    return tuple(_stamp(path) for path in paths if path is not None)


def _stamp(path: Path) -> tuple[int, int, int] | None:
    try:
        status = path.stat()
    except OSError:
        return None
    return status.st_mtime_ns, status.st_size, status.st_ino


def _no_password() -> str:
    raise ValueError("the key needs a password, which the agent does not ask for")


def _element(der: bytes, at: int) -> tuple[int, int, int]:
    """Tag, start and end of the content of the DER element at a place."""
    tag, length, start = der[at], der[at + 1], at + 2
    if length & 0x80:
        count = length & 0x7F
        length, start = int.from_bytes(der[start : start + count], "big"), start + count
    if start + length > len(der):
        raise ValueError("it is cut short")
    return tag, start, start + length


def _time(der: bytes, at: int) -> tuple[int, int]:
    """The time at a place, in seconds since the epoch, and where it ends."""
    tag, start, end = _element(der, at)
    text = der[start:end].decode("ascii")
    if tag == _UTC_TIME:  # two digits of the year: 1950 to 2049
        text = ("19" if text >= "50" else "20") + text
    elif tag != _GENERALIZED_TIME:
        raise ValueError("a validity that is no time")
    return calendar.timegm(time.strptime(text, "%Y%m%d%H%M%SZ")), end
