"""Rotation: deletes a robot's old certificates once it has stayed connected with its new one."""

from __future__ import annotations

import time
from collections.abc import Callable

from iort_contract.tables import CERTIFICATE_ID, ONLINE, SESSION_VERSION
from iort_station.cloud import Cloud
from iort_station.errors import StationError
from iort_station.fleet import registry
from iort_station.fleet.identity import certificates
from iort_station.fleet.identity.certificates import Certificate

# `iort-agent renew` returns to the old certificate if the new one does not connect within 60 s, so a robot
# keeps a connection that is older than that.
SETTLED_S = 90.0
_LOOK_S = 1.0


def finish(
    cloud: Cloud,
    robot: str,
    *,
    settled_s: float = SETTLED_S,
    wait_s: float = 3600.0,
    progress: Callable[[str], None] = lambda _what: None,
) -> list[Certificate]:
    """Wait until the robot has been connected with its newest certificate for ``settled_s`` without a break,
    then revoke and delete the others; returns these.

    Nothing changes before that, so the robot can always connect, and the wait may be stopped and repeated.
    ``progress`` receives what it waits for. Raises `StationError` if the robot is not registered, has no
    active certificate, or does not settle within ``wait_s``.
    """
    registry.get(cloud, robot)
    deadline, settling, said = time.monotonic() + wait_s, None, ""
    while True:
        held = certificates.attached(cloud, robot)
        active = [certificate for certificate in held if certificate.status == "ACTIVE"]
        if not active:
            raise StationError(f"robot {robot} has no active certificate: make a claim (`iort robots claim`)")
        newest, row = active[-1], registry.get(cloud, robot)
        if not row.get(ONLINE):
            now, session = f"{robot} is not connected", None
        elif row.get(CERTIFICATE_ID) != newest.id:
            now, session = f"{robot} is still connected with an older certificate", None
        else:
            now, session = f"{robot} has its new certificate", (newest.id, row.get(SESSION_VERSION))
        if session is None:
            settling = None
        elif settling is None or settling[0] != session:
            settling = (session, time.monotonic())
        if settling is not None and time.monotonic() - settling[1] >= settled_s:
            break
        if now != said:
            progress(now)
            said = now
        if time.monotonic() > deadline:
            raise StationError(f"{now}; its old certificate stays. Run this again later")
        # The registry sends no events.
        time.sleep(_LOOK_S)
    old = [certificate for certificate in held if certificate.id != newest.id]
    for certificate in old:
        certificates.revoke(cloud, certificate)
        certificates.delete(cloud, robot, certificate)
    return old
