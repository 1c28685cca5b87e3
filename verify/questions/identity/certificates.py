"""Certificates: renewal by the agent's own code, and what ends with a removal or a deactivation."""

from __future__ import annotations

import json
import shutil
import time

from iort_agent.errors import IdentityError
from iort_agent.verbs import provision
from iort_station.fleet import identity, robots
from testkit.mqtt import CONNECT_AGAIN_S, Robot, refusal, soon_refused
from testkit.target import Target
from testkit.waiting import InstrumentError, until
from verify.question import Seen, question
from verify.tools.robots import registered, removed_after

_MQTT = "https://docs.aws.amazon.com/iot/latest/developerguide/mqtt.html"
_GUIDE = "https://docs.aws.amazon.com/iot/latest/developerguide"
_API = "https://docs.aws.amazon.com/iot/latest/apireference"
# How the name of a question's policy begins, behind the namespace.
POLICY = "verify-policy"


@question(
    "renewal.rotated",
    expected={
        "certificates_until_it_settles": 2,
        "revoked": 1,
        "new_one_stays_connected": True,
        "old_one_connects": False,
    },
    source=f"{_GUIDE}/provision-wo-cert.html and {_GUIDE}/life-cycle-events.html",
    relied_on_by=(
        "device/iort_agent/verbs/provision.py",
        "station/iort_station/fleet/identity.py",
        "functions/presence.py",
    ),
)
def rotated(target: Target) -> Seen:
    """A registered robot gets a second certificate by a claim and connects with it. After that, the first
    one is revoked and deleted, and does not connect."""
    bundle = registered(target, "verify-rotated")
    before = target.folder / "claims" / f"{bundle.robot}-before"
    shutil.copytree(bundle.folder, before)
    claim = identity.claim(target.cloud, bundle.robot, out=target.folder / "claims" / bundle.robot)
    try:
        provision.renew(bundle.config, claim, status_socket=bundle.folder / "none.sock")
    except IdentityError as error:
        raise InstrumentError(str(error)) from error
    renewed = len(identity.certificates(target.cloud, bundle.robot))
    time.sleep(CONNECT_AGAIN_S)
    with Robot(bundle.folder) as robot:
        robot.online()
        ended = identity.finish_rotation(target.cloud, bundle.robot, settled_s=0, wait_s=50)
        code = soon_refused(before)
        stays = not robot.lost.is_set()
    return {
        "certificates_until_it_settles": renewed,
        "revoked": len(ended),
        "new_one_stays_connected": stays,
        "old_one_connects": code is None,
        "note_code": code,
    }


@question(
    "removal.policy_deleted_after_detach",
    expected={"deleted_within_six_minutes": True},
    source=f"{_API}/API_DeletePolicy.html",
    relied_on_by=("scripts/destroy.py",),
)
def policy_deleted_after_detach(target: Target) -> Seen:
    """A detached policy is deleted at once or within five minutes; until then AWS refuses it with
    DeleteConflictException. `make destroy` retries for six."""
    # Up to six minutes in the worst case that AWS documents: a policy must not stay behind.
    iot, name = target.cloud.client("iot"), f"{target.cloud.namespace}-{target.name(POLICY)}"
    statement = {"Effect": "Deny", "Action": "iot:Connect", "Resource": "*"}
    document = json.dumps({"Version": "2012-10-17", "Statement": [statement]})
    codes: set[str] = set()

    def deleted() -> bool:
        try:
            iot.delete_policy(policyName=name)
        except iot.exceptions.DeleteConflictException as error:
            codes.add(error.response["Error"]["Code"])
            return False
        return True

    made = identity.make_certificate(iot, name)
    try:
        iot.create_policy(policyName=name, policyDocument=document)
        iot.attach_policy(policyName=name, target=made.arn)
        iot.detach_policy(policyName=name, target=made.arn)
        until(deleted, "the deletion of a detached policy", within_s=360)
    finally:
        iot.update_certificate(certificateId=made.id, newStatus="REVOKED")
        identity.once_detached(iot, iot.delete_certificate, certificateId=made.id, forceDelete=True)
    return {"deleted_within_six_minutes": True, "note_at_once": not codes, "note_refused_with": sorted(codes)}


@question(
    "removal.robot_removed",
    expected={"session_ended": True, "connects_again": False},
    source=f"{_MQTT} and {_API}/API_DeleteCertificate.html",
    relied_on_by=(
        "station/iort_station/fleet/robots.py",
        "station/iort_station/fleet/identity.py",
    ),
)
def robot_removed(target: Target) -> Seen:
    """`iort robots remove` ends the robot's session and deletes its certificate, its thing and its row in a
    row. The robot does not connect again."""
    with removed_after(target, "verify-removed") as (name, folder):
        bundle = robots.add(target.cloud, name, out=folder)
        with Robot(bundle.folder) as robot:
            robot.online()
            robots.remove(target.cloud, name)
            ended = robot.lost.wait(30)
    code = soon_refused(bundle.folder)
    return {"session_ended": ended, "connects_again": code is None, "note_code": code}


@question(
    "removal.certificate_deactivated",
    expected={"connects_before": True, "connects_after": False},
    source=f"{_API}/API_UpdateCertificate.html",
    relied_on_by=("station/iort_station/fleet/identity.py", "device/iort_agent/mqtt/failures.py"),
)
def certificate_deactivated(target: Target) -> Seen:
    """A certificate that is not active does not connect."""
    bundle = registered(target, "verify-deactivated")
    before = refusal(bundle.folder)
    (certificate,) = identity.certificates(target.cloud, bundle.robot)
    target.cloud.client("iot").update_certificate(certificateId=certificate.id, newStatus="INACTIVE")
    code = soon_refused(bundle.folder)
    return {"connects_before": before is None, "connects_after": code is None, "note_code": code}
