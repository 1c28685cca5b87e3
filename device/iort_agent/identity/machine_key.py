"""The machine's serial number, and a private key made on the machine."""

from __future__ import annotations

import contextlib
from pathlib import Path

from iort_agent.errors import IdentityError
from iort_agent.identity.certificate import load_x509

# Place Linux tells the machine's serial number; the first file that exists counts.
_SERIALS = (Path("/proc/device-tree/serial-number"), Path("/etc/machine-id"))


def make_key(robot: str) -> tuple[str, str]:
    """Make a new private key and its certificate signing request, both as PEM. Writes no file."""
    x509 = load_x509()
    from cryptography.hazmat.primitives import hashes, serialization  # noqa: PLC0415 - as in `load_x509`
    from cryptography.hazmat.primitives.asymmetric import ec  # noqa: PLC0415 - as above

    key = ec.generate_private_key(ec.SECP256R1())
    subject = x509.Name([x509.NameAttribute(x509.NameOID.COMMON_NAME, robot)])
    request = x509.CertificateSigningRequestBuilder(subject).sign(key, hashes.SHA256())
    pem = key.private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    )
    return pem.decode(), request.public_bytes(serialization.Encoding.PEM).decode()


def machine_serial() -> str:
    """The machine's serial number. If the hardware has one, a copy of the disk image does not share it."""
    for path in _SERIALS:
        with contextlib.suppress(OSError, UnicodeDecodeError):
            serial = path.read_text(encoding="ascii").strip("\0 \n")
            if serial:
                return serial
    raise IdentityError("this machine has no serial number: set `serial` in the claim's file")
