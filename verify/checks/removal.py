"""Removal: a policy right after its detachment, a robot, a certificate's right to connect."""

from __future__ import annotations

import json
from typing import Any

from bench.target import Target
from iort_station.fleet import certificates, robots
from verify.assumption import Basis
from verify.bundles import registered, removed_after
from verify.check import Check
from verify.robot import Robot, refusal, soon_refused
from verify.waiting import until

_MQTT = "https://docs.aws.amazon.com/iot/latest/developerguide/mqtt.html"
_API = "https://docs.aws.amazon.com/iot/latest/apireference"
# How the name of a question's policy begins, behind the namespace.
POLICY = "verify-policy"


def _policy_deleted(target: Target) -> dict[str, Any]:
    """Up to six minutes in the worst case that AWS documents: a policy must not stay behind."""
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

    made = certificates.make(iot, name)
    try:
        iot.create_policy(policyName=name, policyDocument=document)
        iot.attach_policy(policyName=name, target=made.arn)
        iot.detach_policy(policyName=name, target=made.arn)
        until(deleted, "the deletion of a detached policy", within_s=360)
    finally:
        iot.update_certificate(certificateId=made.id, newStatus="REVOKED")
        certificates.once_detached(iot, iot.delete_certificate, certificateId=made.id, forceDelete=True)
    return {"deleted_within_six_minutes": True, "note_at_once": not codes, "note_refused_with": sorted(codes)}


def _removed(target: Target) -> dict[str, Any]:
    with removed_after(target, "verify-removed") as (name, folder):
        bundle = robots.add(target.cloud, name, out=folder)
        with Robot(bundle.folder) as robot:
            robot.online()
            robots.remove(target.cloud, name)
            ended = robot.lost.wait(30)
    code = soon_refused(bundle.folder)
    return {"session_ended": ended, "connects_again": code is None, "note_code": code}


def _deactivated(target: Target) -> dict[str, Any]:
    bundle = registered(target, "verify-deactivated")
    before = refusal(bundle.folder)
    (certificate,) = certificates.attached(target.cloud, bundle.robot)
    target.cloud.client("iot").update_certificate(certificateId=certificate.id, newStatus="INACTIVE")
    code = soon_refused(bundle.folder)
    return {"connects_before": before is None, "connects_after": code is None, "note_code": code}


CHECKS = (
    Check(
        name="removal.policy_deleted_after_detach",
        assumed=(
            "A detached policy is deleted at once or within five minutes; until then AWS refuses it "
            "with DeleteConflictException. `make destroy` retries for six."
        ),
        expected={"deleted_within_six_minutes": True},
        basis=Basis.DOCUMENTED,
        source=f"{_API}/API_DeletePolicy.html",
        relied_on_by=("scripts/destroy.py",),
        ask=_policy_deleted,
    ),
    Check(
        name="removal.robot_removed",
        assumed=(
            "`iort robots remove` ends the robot's session and deletes its certificate, its thing and its "
            "row in a row. The robot does not connect again."
        ),
        expected={"session_ended": True, "connects_again": False},
        basis=Basis.DOCUMENTED,
        source=f"{_MQTT} and {_API}/API_DeleteCertificate.html",
        relied_on_by=("station/iort_station/fleet/robots.py", "station/iort_station/fleet/certificates.py"),
        ask=_removed,
    ),
    Check(
        name="removal.certificate_deactivated",
        assumed="A certificate that is not active does not connect.",
        expected={"connects_before": True, "connects_after": False},
        basis=Basis.DOCUMENTED,
        source=f"{_API}/API_UpdateCertificate.html",
        relied_on_by=("station/iort_station/fleet/rotation.py", "device/iort_agent/mqtt/failures.py"),
        ask=_deactivated,
    ),
)
