"""What tells this machine from others, and a key that is made on it, with the openssl command."""

from __future__ import annotations

import contextlib
import subprocess
from pathlib import Path

from iort_agent.errors import IdentityError

# Where Linux says which machine this is; the first that there is.
_SERIALS = (Path("/proc/device-tree/serial-number"), Path("/etc/machine-id"))


def make_key(robot: str) -> tuple[str, str]:
    """A new key and a request to certify it, both as PEM. The key is in no file yet."""
    key = _openssl(["genpkey", "-algorithm", "EC", "-pkeyopt", "ec_paramgen_curve:P-256"])
    request = _openssl(["req", "-new", "-sha256", "-key", "/dev/stdin", "-subj", f"/CN={robot}"], key)
    return key, request


def machine_serial() -> str:
    """What tells this machine from others, and stays when its disk image is copied, if it has such."""
    for path in _SERIALS:
        with contextlib.suppress(OSError, UnicodeDecodeError):
            serial = path.read_text(encoding="ascii").strip("\0 \n")
            if serial:
                return serial
    raise IdentityError("this machine has no serial number to be found: set `serial` in the claim's file")


def _openssl(arguments: list[str], given: str | None = None) -> str:
    try:
        done = subprocess.run(  # noqa: S603 - the arguments are ours, and no shell reads them
            ["openssl", *arguments],  # noqa: S607 - wherever the distribution has it
            input=given, capture_output=True, text=True, check=False,
        )  # fmt: skip
    except OSError as error:
        raise IdentityError(
            f"the openssl command is needed: {error} (Debian: apt install openssl)"
        ) from error
    if done.returncode:
        raise IdentityError(f"openssl {arguments[0]} failed: {done.stderr.strip()[-300:]}")
    return done.stdout
