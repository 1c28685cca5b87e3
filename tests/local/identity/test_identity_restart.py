"""Provisioning is killed and restarted on the embedded cloud: only the holder of the issued certificate gets
the name.
"""

from __future__ import annotations

import json
import signal
import stat
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from iort_station.fleet import identity
from local.cloud import ROOT
from testkit.mqtt import Robot
from tests.local.conftest import command
from tests.local.identity.test_identity import certificates

# The process dies as if the battery failed: before AWS IoT is asked to register, or right after.
KILLED = """
import os, signal, sys
from pathlib import Path
from iort_agent.verbs.registration import Exchange
from iort_agent.verbs import provision as identity
from iort_agent.verbs.registration import Seams

class Killed(Exchange):
    def register(self, token, parameters):
        if sys.argv[1] == "after":
            super().register(token, parameters)
        os.kill(os.getpid(), signal.SIGKILL)

seams = Seams(exchange=Killed)
verb, file, other = sys.argv[2:]
if verb == "provision":
    identity.provision(Path(file), robot=other, seams=seams)
else:
    identity.renew(Path(file), Path(other), status_socket=Path("none.sock"), seams=seams)
"""
NAME = ".provisioning.json"


def killed(when: str, verb: str, file: Path, other: object) -> dict[str, Any]:
    """Run a verb until it is killed; return the state file for the next run."""
    done = subprocess.run(
        [sys.executable, "-c", KILLED, when, verb, str(file), str(other)],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    assert done.returncode == -signal.SIGKILL, done.stderr
    left = file.parent / NAME
    assert stat.S_IMODE(left.stat().st_mode) == 0o600
    assert not (file.parent / "private.key").exists() or verb == "renew"
    found: dict[str, Any] = json.loads(left.read_text())
    return found


def made(embedded: Any, name: str, folder: Path, *, lasting: bool) -> Path:
    """Make a claim of either kind that can take the name."""
    if not lasting:
        return identity.claim(embedded.cloud, name, out=folder)
    identity.register(embedded.cloud, name)
    return identity.claim(embedded.cloud, None, out=folder, lasting=True)


def drives(folder: Path, left: dict[str, Any]) -> None:
    """Check that the robot has its first certificate and connects with it."""
    assert (folder / "certificate.pem").read_text() == left["certificate"]
    assert not (folder / NAME).exists()
    with Robot(folder) as robot:
        robot.online()


@pytest.mark.parametrize(("when", "lasting"), [("before", True), ("after", False)])
def test_a_killed_provisioning_is_resumed(embedded, tmp_path, when, lasting):
    name = f"killed-{when}-{lasting}"
    claim = made(embedded, name, tmp_path / "claim", lasting=lasting)
    left = killed(when, "provision", claim, name)
    command("provision", "--config", claim, "--robot", name)
    drives(claim.parent, left)
    assert len(certificates(embedded, name)) == 1


def test_a_killed_renewal_is_resumed(embedded, bundle, tmp_path):
    car = bundle()
    before = (car.folder / "certificate.pem").read_text()
    claim = identity.claim(embedded.cloud, car.robot, out=tmp_path / "claim")
    left = killed("after", "renew", car.config, claim)
    assert (car.folder / "certificate.pem").read_text() == before
    command("renew", "--config", car.config, "--claim", claim)
    drives(car.folder, left)
    assert not list(car.folder.glob("*.previous"))
