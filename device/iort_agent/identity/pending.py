"""Keeps a certificate that was issued but may not be registered yet, until it is in its place.

AWS IoT admits a name for one certificate. A run that stops in between would otherwise lose the certificate's
key, and the next run would request a name that is already used.
"""

from __future__ import annotations

import contextlib
import json
import logging
from dataclasses import asdict, dataclass
from pathlib import Path, PurePath

from iort_agent.common.private_files import open_below, write_below

_log = logging.getLogger(__name__)

_NAME = PurePath(".provisioning.json")
_MAX_BYTES = 64 * 1024
# "The certificateOwnershipToken expires after one hour", and the certificate is deleted then if it was not
# registered ("Device provisioning MQTT API").
TOKEN_S = 3600.0


@dataclass(frozen=True)
class Pending:
    """An issued certificate with its key and token, for whom it is, and this machine's time of the
    request."""

    robot: str
    serial: str
    endpoint: str
    namespace: str
    private_key: str
    certificate: str
    token: str
    asked_s: float

    def is_for(self, robot: str, serial: str, endpoint: str, namespace: str) -> bool:
        """Whether it was issued for this robot of this deployment."""
        own = (self.robot, self.serial, self.endpoint, self.namespace)
        return own == (robot, serial, endpoint, namespace)

    def may_register(self, now_s: float) -> bool:
        """Whether the token may still be valid. A request from the future means that the clock was set."""
        return 0 <= now_s - self.asked_s < TOKEN_S


def keep(folder: Path, pending: Pending) -> None:
    """Write it to the disk, readable by its owner only. Raises `OSError`."""
    folder.mkdir(parents=True, exist_ok=True, mode=0o700)
    write_below(folder, _NAME, json.dumps(asdict(pending)).encode(), sync=True)


def kept(folder: Path) -> Pending | None:
    """What an earlier run left; None if it left nothing readable."""
    try:
        with open_below(folder, _NAME) as file:
            said = json.loads(file.read(_MAX_BYTES))
        asked_s = float(said.pop("asked_s"))
        return Pending(asked_s=asked_s, **{name: str(value) for name, value in said.items()})
    except FileNotFoundError:
        return None
    except (OSError, ValueError, TypeError, KeyError, AttributeError) as error:
        _log.warning("%s is ignored: %s", folder / _NAME, error)
        return None


def forget(folder: Path) -> None:
    """Delete it."""
    with contextlib.suppress(FileNotFoundError):
        (folder / _NAME).unlink()
