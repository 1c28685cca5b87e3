"""A robot's life in the registry: expected, provisioned, connected, rotated, removed."""

from __future__ import annotations

import json
import threading
from importlib.metadata import version

import pytest

from iort_contract.tables import (
    ADMITTED_CERTIFICATE,
    AGENT_VERSION,
    CERTIFICATE_ID,
    CONNECTED_MS,
    DISCONNECT_REASON,
    LAST_SEEN_MS,
    ONLINE,
    SERIAL,
)
from iort_station.errors import StationError
from iort_station.fleet import identity, registry, robots
from testkit.mqtt import STALE, Robot
from testkit.waiting import GUARD_S, until
from tests.local.conftest import command


def row(embedded, name):
    return registry.get(embedded.cloud, name)


def test_only_the_registered_machine_gets_its_name(embedded, tmp_path, iort):
    assert iort("robots", "register", "expected", "--serial", "s1").exit_code == 0
    assert "expected until" in iort("robots", "list").output
    lasting = identity.claim(embedded.cloud, None, out=tmp_path, lasting=True)
    text = lasting.read_text()
    lasting.write_text(f"{text}serial: s2\n")
    assert "AccessDenied" in command("provision", "--config", lasting, "--robot", "expected", status=1).stderr
    lasting.write_text(f"{text}serial: s1\n")
    command("provision", "--config", lasting, "--robot", "expected")
    after = row(embedded, "expected")
    assert after[SERIAL] == "s1"
    assert "expected until" not in iort("robots", "show", "expected").output
    (held,) = identity.certificates(embedded.cloud, "expected")
    assert (held.id, held.status) == (after[ADMITTED_CERTIFICATE], "ACTIVE")
    # The same machine with the same claim gets the name once; a second time needs a new registration.
    command("provision", "--config", lasting, "--robot", "expected", status=1)
    shown = json.loads(iort("robots", "show", "expected", "--json").output)
    assert [one["id"] for one in shown["certificates"]] == [held.id]


def test_the_registry_follows_a_robot(embedded, bundle, iort):
    car = bundle(sources=[{"type": "sim", "stream": "vesc", "rate_hz": 50, "duration_s": 1}])
    command("--config", car.config)
    after = until(
        lambda: (
            (now := row(embedded, car.robot)).get(ONLINE) is False
            and {AGENT_VERSION, CONNECTED_MS} <= now.keys()
            and now
        ),
    )
    assert after[DISCONNECT_REASON] == "CLIENT_INITIATED_DISCONNECT"
    assert after[LAST_SEEN_MS] >= after[CONNECTED_MS] > 0
    assert after[AGENT_VERSION] == version("iort-agent")
    (held,) = identity.certificates(embedded.cloud, car.robot)
    assert after[CERTIFICATE_ID] == held.id
    assert "offline since" in iort("robots", "list").output
    with Robot(car.folder) as robot:
        robot.online()
        until(lambda: row(embedded, car.robot)[ONLINE])
        assert "online since" in iort("robots", "show", car.robot).output


def test_a_removed_robot_is_disconnected_and_cannot_reconnect(embedded, bundle):
    car = bundle()
    embedded.cloud.client("iot-data").update_thing_shadow(
        thingName=car.robot, shadowName="agent", payload=b'{"state": {"desired": {"log_level": "debug"}}}'
    )
    with Robot(car.folder) as robot:
        robot.online()
        robots.remove(embedded.cloud, car.robot)
        assert robot.lost.wait(GUARD_S)
    with Robot(car.folder) as again:
        assert again.refused.wait(GUARD_S)
        assert not again.connected.is_set()
    with pytest.raises(StationError, match="not registered"):
        registry.get(embedded.cloud, car.robot)
    # The next robot of that name inherits no shadow.
    data = embedded.cloud.client("iot-data")
    with pytest.raises(data.exceptions.ResourceNotFoundException):
        data.get_thing_shadow(thingName=car.robot, shadowName="agent")


def test_a_session_ends_with_its_certificate(embedded, bundle):
    """AWS does so within minutes; local/patches/certificate_status.patch closes the emulator's gap."""
    car = bundle()
    with Robot(car.folder) as robot:
        robot.online()
        (held,) = identity.certificates(embedded.cloud, car.robot)
        embedded.cloud.client("iot").update_certificate(certificateId=held.id, newStatus="INACTIVE")
        assert robot.lost.wait(GUARD_S)
    until(
        lambda: row(embedded, car.robot).get(DISCONNECT_REASON) == "AUTH_ERROR",
    )


def test_delete_connection_disconnects_only_one_client(embedded, bundle):
    first, second = bundle("-1"), bundle("-2")
    with Robot(first.folder) as one, Robot(second.folder) as two:
        one.online()
        two.online()
        assert identity.end_session(embedded.cloud, first.robot) is True
        assert one.lost.wait(GUARD_S)
        assert two.publish(f"live/iort/{second.robot}/vesc", STALE) == "SUCCESS"
    until(
        lambda: row(embedded, first.robot).get(DISCONNECT_REASON) == "API_INITIATED_DISCONNECT",
    )
    assert identity.end_session(embedded.cloud, first.robot) is False


def test_rotation_waits_for_the_new_certificate(embedded, bundle, tmp_path):
    car = bundle()
    (old,) = identity.certificates(embedded.cloud, car.robot)
    heard, done = [], threading.Event()

    def finish():
        heard.append(identity.finish_rotation(embedded.cloud, car.robot, settled_s=0, progress=heard.append))
        done.set()

    with Robot(car.folder) as robot:
        robot.online()
        claim = identity.claim(embedded.cloud, car.robot, out=tmp_path / "claim")
        (tmp_path / "new").mkdir()
        (tmp_path / "new" / "car.yaml").write_text(car.config.read_text())
        for file in ("private.key", "certificate.pem", "root-ca.pem"):
            (tmp_path / "new" / file).write_bytes((car.folder / file).read_bytes())
        command("provision", "--config", _writing_to(claim, tmp_path / "new" / "car.yaml"))
        assert len(identity.certificates(embedded.cloud, car.robot)) == 2
        waiting = threading.Thread(target=finish)
        waiting.start()
        until(lambda: heard)
        # The old certificate is connected and stays connected.
        assert "older certificate" in heard[0]
        assert robot.publish(f"live/iort/{car.robot}/vesc", STALE) == "SUCCESS"
        assert not done.is_set()
    with Robot(tmp_path / "new") as robot:
        robot.online()
        assert done.wait(GUARD_S)
        waiting.join()
        assert [one.id for one in heard[-1]] == [old.id]
        assert not robot.lost.is_set()
    with Robot(car.folder) as robot:
        assert robot.refused.wait(GUARD_S)


def _writing_to(claim, config):
    claim.write_text(f"{claim.read_text()}config: {config}\n")
    return claim


def test_rotation_keeps_the_old_certificate_of_an_offline_robot(embedded, bundle):
    car = bundle()
    with pytest.raises(StationError, match="not connected; its old certificate stays"):
        identity.finish_rotation(embedded.cloud, car.robot, wait_s=0)
    (held,) = identity.certificates(embedded.cloud, car.robot)
    assert held.status == "ACTIVE"


def test_a_revoked_claim_cannot_provision(embedded, tmp_path, iort):
    identity.register(embedded.cloud, "too-late")
    lasting = identity.claim(embedded.cloud, None, out=tmp_path, lasting=True)
    assert "lasting claims revoked: " in iort("robots", "revoke-claims", "--yes").output
    assert (
        "the claim does not connect"
        in command("provision", "--config", lasting, "--robot", "too-late", status=1).stderr
    )
    assert identity.revoke_claims(embedded.cloud) == 0


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("remove",), "give a robot's name, or --all"),
        (("remove", "x", "--all"), "give a robot's name, or --all"),
        (("claim",), "give the robot's name, or --lasting"),
        (("register", "a", "b", "--serial", "s"), "--serial is for one machine"),
        (("register", "a/b"), "got 'a/b'"),
    ],
)
def test_invalid_arguments_are_rejected(iort, arguments, said):
    outcome = iort("robots", *arguments)
    assert outcome.exit_code != 0
    assert said in str(outcome.exception)


def test_the_removal_of_a_robot_needs_a_confirmation(embedded, bundle, iort):
    car = bundle()
    asked = iort("robots", "remove", car.robot)
    assert str(asked.exception).endswith("Nobody can answer here: give --yes")
    assert registry.get(embedded.cloud, car.robot)
