"""A claim becomes a driving robot with its next certificate, on the embedded cloud."""

from __future__ import annotations

import stat
from typing import Any

import pytest
import yaml

from iort_contract.cloud import claim_name
from iort_contract.tables import ROBOT
from iort_station.fleet import identity, robots
from iort_station.operations import audit
from testkit.mqtt import WAIT_S, Robot
from testkit.waiting import until
from tests.local.conftest import command, run_agent
from tests.local.data.drives import Agent


def certificates(embedded: Any, robot: str) -> list[str]:
    found: list[str] = embedded.cloud.client("iot").list_thing_principals(thingName=robot)["principals"]
    return found


def test_a_claim_provisions_a_robot_that_drives(embedded, tmp_path):
    claim = identity.claim(embedded.cloud, "claimed", out=tmp_path / "claim")
    command("provision", "--config", claim)
    bundle = robots.Bundle("claimed", tmp_path / "claim")
    for name in ("private.key", "certificate.pem", "car.yaml", "claim-private.key", "claim.yaml"):
        assert stat.S_IMODE((bundle.folder / name).stat().st_mode) == 0o600, name
    described = embedded.cloud.client("iot").describe_thing(thingName="claimed")
    assert (described["thingTypeName"], described["attributes"]["vehicle"]) == ("iort-robot", "vesc")
    assert any(row[ROBOT] == "claimed" for row in robots.listed(embedded.cloud))
    robots.configure(bundle, {"sources": [{"type": "sim", "stream": "vesc", "rate_hz": 50, "duration_s": 1}]})
    run_agent(bundle)
    until(lambda: audit.delivery(embedded.cloud, "claimed", "vesc").samples_stored == 50)
    robots.remove(embedded.cloud, "claimed")


def test_a_second_robot_cannot_take_a_taken_name(embedded, tmp_path):
    first = identity.claim(embedded.cloud, "taken", out=tmp_path / "first")
    command("provision", "--config", first)
    second = identity.claim(embedded.cloud, None, out=tmp_path / "second", lasting=True)
    settings = yaml.safe_load(second.read_text())
    owner = embedded.cloud.client("iot").describe_thing(thingName="taken")["attributes"]["serial"]
    for serial in ("another-machine", owner):
        second.write_text(yaml.safe_dump({**settings, "serial": serial}))
        done = command("provision", "--config", second, "--robot", "taken", status=1)
        assert "RegisterThing was refused: AccessDenied" in done.stderr
        assert "Traceback" not in done.stderr
    assert not (tmp_path / "second" / "car.yaml").exists()
    assert len(certificates(embedded, "taken")) == 1


def test_a_lasting_claim_allows_only_provisioning(embedded, tmp_path):
    claim = identity.claim(embedded.cloud, None, out=tmp_path, lasting=True)
    command("provision", "--config", claim, status=2)  # no name
    refused = command("provision", "--config", claim, "--robot", "lasting", status=1)
    assert "AccessDenied" in refused.stderr  # the name is not registered
    identity.register(embedded.cloud, "lasting")
    command("provision", "--config", claim, "--robot", "lasting")
    # The claim may do nothing as a robot.
    for name in ("certificate.pem", "private.key"):
        (tmp_path / f"claim-{name}").replace(tmp_path / name)
    with Robot(tmp_path, client_id="lasting") as robot:
        assert robot.refused.wait(WAIT_S)
    with Robot(tmp_path, client_id=f"{claim_name()}-x") as robot:
        assert robot.online().publish("dt/iort/lasting/vesc", b"{}") == "NOT_AUTHORIZED"
        assert robot.subscribe("#") == "NOT_AUTHORIZED"
        assert robot.subscribe("$aws/certificates/create-from-csr/json/accepted") == "GRANTED_QOS_1"
        assert robot.subscribe("$aws/certificates/create/json/accepted") == "NOT_AUTHORIZED"


def test_a_revoked_claim_is_reported(embedded, tmp_path):
    claim = identity.claim(embedded.cloud, None, out=tmp_path, lasting=True)
    iot = embedded.cloud.client("iot")
    for certificate in iot.list_targets_for_policy(policyName=claim_name())["targets"]:
        iot.update_certificate(certificateId=certificate.rsplit("/", 1)[-1], newStatus="REVOKED")
    done = command("provision", "--config", claim, "--robot", "late", status=1)
    assert "the claim does not connect" in done.stderr
    assert "iort robots claim" in done.stderr


def test_an_existing_configuration_is_updated_and_keeps_its_comments(embedded, tmp_path):
    claim = identity.claim(embedded.cloud, "updated", out=tmp_path)
    car = tmp_path / "car.yaml"
    car.write_text("# my car\nrobot: other\nport: 1  # wrong\nsources:\n  - type: sim # a comment\n")
    command("provision", "--config", claim)
    text = car.read_text()
    assert "# my car" in text
    assert "# a comment" in text
    assert yaml.safe_load(text)["robot"] == "updated"
    assert yaml.safe_load(text)["port"] == embedded.cloud.mqtt_port


def test_a_certificate_is_renewed_without_an_agent(embedded, bundle, tmp_path):
    car = bundle()
    before = (car.folder / "certificate.pem").read_text()
    claim = identity.claim(embedded.cloud, car.robot, out=tmp_path / "claim")
    command("renew", "--config", car.config, "--claim", claim)
    assert (car.folder / "certificate.pem").read_text() != before
    assert not list(car.folder.glob("*.previous"))
    assert len(certificates(embedded, car.robot)) == 2
    with Robot(car.folder) as robot:
        robot.online()


def test_a_failed_renewal_keeps_the_old_certificate(embedded, bundle, tmp_path, monkeypatch):
    from iort_agent.errors import IdentityError
    from iort_agent.verbs import provision

    car = bundle()
    before = (car.folder / "certificate.pem").read_text(), (car.folder / "private.key").read_text()
    claim = identity.claim(embedded.cloud, car.robot, out=tmp_path / "claim")

    def fails(*_: object) -> None:
        raise IdentityError("no")

    monkeypatch.setattr(provision, "_try_alone", fails)
    with pytest.raises(IdentityError):
        provision.renew(car.config, claim, status_socket=tmp_path / "none.sock")
    assert before == (
        (car.folder / "certificate.pem").read_text(),
        (car.folder / "private.key").read_text(),
    )


def test_a_certificate_is_renewed_while_the_agent_runs(embedded, bundle, tmp_path):
    car = bundle(sources=[{"type": "sim", "stream": "vesc", "rate_hz": 50}])
    claim = identity.claim(embedded.cloud, car.robot, out=tmp_path / "claim")
    with Agent(car) as agent:
        until(lambda: agent.told()["connection"]["connected"])
        command("renew", "--config", car.config, "--claim", claim)
        held = agent.told()["connection"]["certificate_id"]
        # The old certificate is no longer needed.
        old, new = sorted(certificates(embedded, car.robot), key=lambda arn: arn.endswith(held))
        assert new.endswith(held)
        embedded.cloud.client("iot").update_certificate(
            certificateId=old.rsplit("/", 1)[-1], newStatus="REVOKED"
        )
    sent = agent.report()["streams"]["vesc"]["samples"]
    until(lambda: audit.delivery(embedded.cloud, car.robot, "vesc").samples_stored == sent)
