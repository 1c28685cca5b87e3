"""Provisioning is killed and restarted on the embedded cloud: only the holder of the issued certificate gets
the name.
"""

from __future__ import annotations

import json
import signal
import stat
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest

from functions.admit import SETTLED_MS
from iort_agent.identity import parse_certificate
from iort_contract.tables import ADMIT_CLAIM, ADMITTED_CERTIFICATE, ADMITTED_MS, ROBOT, SERIAL
from iort_station.fleet import identity, registry
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


@pytest.mark.parametrize("lasting", [False, True])
@pytest.mark.parametrize("when", ["before", "after"])
def test_a_killed_provisioning_is_resumed(embedded, tmp_path, when, lasting):
    name = f"killed-{when}-{lasting}"
    claim = made(embedded, name, tmp_path / "claim", lasting=lasting)
    left = killed(when, "provision", claim, name)
    command("provision", "--config", claim, "--robot", name)
    drives(claim.parent, left)
    assert len(certificates(embedded, name)) == 1


def test_an_issued_certificate_needs_no_valid_claim(embedded, tmp_path):
    for when, status in (("after", 0), ("before", 1)):
        name = f"ended-{when}"
        claim = made(embedded, name, tmp_path / when, lasting=True)
        left = killed(when, "provision", claim, name)
        iot = embedded.cloud.client("iot")
        its = parse_certificate((claim.parent / "claim-certificate.pem").read_text()).id
        iot.update_certificate(certificateId=its, newStatus="REVOKED")
        done = command("provision", "--config", claim, "--robot", name, status=status)
        if status == 0:
            drives(claim.parent, left)
        else:
            assert "the claim does not connect" in done.stderr
            # The next claim continues the provisioning.
            assert (claim.parent / NAME).exists()
            identity.claim(embedded.cloud, None, out=claim.parent, lasting=True)
            command("provision", "--config", claim, "--robot", name)
            drives(claim.parent, left)


def admit(embedded: Any, left: dict[str, Any], name: str) -> None:
    """Admit the certificate by the hook without registration, as if AWS IoT timed out and the robot died."""
    row = registry.get(embedded.cloud, name)
    answer = embedded.cloud.client("lambda").invoke(
        FunctionName=embedded.cloud.output("fleet", "AdmitFunction"),
        Payload=json.dumps(
            {
                "claimCertificateId": row.get(ADMIT_CLAIM, "any"),
                "certificateId": parse_certificate(left["certificate"]).id,
                "parameters": {"Robot": name, "Serial": left[SERIAL]},
            }
        ),
    )
    assert json.loads(answer["Payload"].read()) == {"allowProvisioning": True}


@pytest.mark.parametrize("lasting", [False, True])
def test_an_unused_admission_can_be_repeated(embedded, tmp_path, lasting):
    name = f"spent-{lasting}"
    claim = made(embedded, name, tmp_path / "claim", lasting=lasting)
    left = killed("before", "provision", claim, name)
    admit(embedded, left, name)
    # The disk is lost, and with it the certificate of the name.
    (claim.parent / NAME).unlink()
    refused = command("provision", "--config", claim, "--robot", name, status=1)
    assert "AccessDenied" in refused.stderr
    later(embedded, name)
    command("provision", "--config", claim, "--robot", name)
    row = registry.get(embedded.cloud, name)
    assert row[ADMITTED_CERTIFICATE] != parse_certificate(left["certificate"]).id
    (held,) = certificates(embedded, name)
    assert held.endswith(row[ADMITTED_CERTIFICATE])
    # The registration succeeded, so nobody else may take the name later.
    later(embedded, name)
    (claim.parent / "car.yaml").unlink()
    command("provision", "--config", claim, "--robot", name, status=1)
    assert certificates(embedded, name) == [held]


def later(embedded: Any, name: str) -> None:
    """Make the admission a minute old."""
    before_ms = time.time_ns() // 1_000_000 - SETTLED_MS
    embedded.cloud.client("dynamodb").update_item(
        TableName=embedded.cloud.output("storage", "RobotsTable"),
        Key={ROBOT: {"S": name}},
        UpdateExpression="SET #at = :before",
        ExpressionAttributeNames={"#at": ADMITTED_MS},
        ExpressionAttributeValues={":before": {"N": str(before_ms)}},
    )


def test_another_robot_cannot_take_the_name_during_provisioning(embedded, tmp_path):
    claim = made(embedded, "wanted", tmp_path / "first", lasting=False)
    left = killed("before", "provision", claim, "wanted")
    admit(embedded, left, "wanted")
    later(embedded, "wanted")
    other = identity.claim(embedded.cloud, None, out=tmp_path / "other", lasting=True)
    refused = command("provision", "--config", other, "--robot", "wanted", status=1)
    assert "AccessDenied" in refused.stderr
    command("provision", "--config", claim)
    drives(claim.parent, left)


@pytest.mark.parametrize("when", ["before", "after"])
def test_a_killed_renewal_is_resumed(embedded, bundle, tmp_path, when):
    car = bundle()
    before = (car.folder / "certificate.pem").read_text()
    claim = identity.claim(embedded.cloud, car.robot, out=tmp_path / "claim")
    left = killed(when, "renew", car.config, claim)
    assert (car.folder / "certificate.pem").read_text() == before
    command("renew", "--config", car.config, "--claim", claim)
    drives(car.folder, left)
    assert not list(car.folder.glob("*.previous"))
