"""Renewal: a registered robot's next certificate, by the agent's own code, and the end of the old one."""

from __future__ import annotations

import shutil
import time
from typing import Any

from bench.target import Target
from iort_agent.errors import IdentityError
from iort_agent.verbs import provision
from iort_station.fleet import certificates, claims, rotation
from verify.assumption import Basis
from verify.bundles import registered
from verify.check import Check
from verify.errors import VerifyError
from verify.robot import CONNECT_AGAIN_S, Robot, soon_refused

_GUIDE = "https://docs.aws.amazon.com/iot/latest/developerguide"


def _rotated(target: Target) -> dict[str, Any]:
    bundle = registered(target, "verify-rotated")
    before = target.folder / "claims" / f"{bundle.robot}-before"
    shutil.copytree(bundle.folder, before)
    claim = claims.claim(target.cloud, bundle.robot, out=target.folder / "claims" / bundle.robot)
    try:
        provision.renew(bundle.config, claim, status_socket=bundle.folder / "none.sock")
    except IdentityError as error:
        raise VerifyError(str(error)) from error
    renewed = len(certificates.attached(target.cloud, bundle.robot))
    time.sleep(CONNECT_AGAIN_S)
    with Robot(bundle.folder) as robot:
        robot.online()
        ended = rotation.finish(target.cloud, bundle.robot, settled_s=0, wait_s=50)
        code = soon_refused(before)
        stays = not robot.lost.is_set()
    return {
        "certificates_until_it_settles": renewed,
        "revoked": len(ended),
        "new_one_stays_connected": stays,
        "old_one_connects": code is None,
        "note_code": code,
    }


CHECKS = (
    Check(
        name="renewal.rotated",
        assumed=(
            "A registered robot gets a second certificate by a claim and connects with it. After that, the "
            "first one is revoked and deleted, and does not connect."
        ),
        expected={
            "certificates_until_it_settles": 2,
            "revoked": 1,
            "new_one_stays_connected": True,
            "old_one_connects": False,
        },
        basis=Basis.DOCUMENTED,
        source=f"{_GUIDE}/provision-wo-cert.html and {_GUIDE}/life-cycle-events.html",
        relied_on_by=(
            "device/iort_agent/verbs/provision.py",
            "station/iort_station/fleet/rotation.py",
            "functions/presence.py",
        ),
        ask=_rotated,
    ),
)
