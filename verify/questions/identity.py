"""Certificates and policies: renewal, removal, versions, and the end of a deployment with a robot."""

from __future__ import annotations

import json
import shutil
import time
from typing import Any

from iort_agent.errors import IdentityError
from iort_agent.verbs import provision
from iort_station.fleet import identity, robots
from testkit.mqtt import CONNECT_AGAIN_S, refusal, soon_refused
from testkit.waiting import InstrumentError, until
from verify.lab import CannotAskError, Lab, said_by
from verify.question import ENDED, Seen, question

# How the name of a question's policy begins, behind the namespace.
POLICY = "verify-policy"


@question(
    "renewal.rotated",
    aws="iot:provision-wo-cert iot:life-cycle-events",
    expected={
        "certificates_until_it_settles": 2,
        "revoked": 1,
        "new_one_stays_connected": True,
        "old_one_connects": False,
    },
)
def rotated(lab: Lab) -> Seen:
    """A registered robot gets a second certificate by a claim and connects with it. After that, the first
    one is revoked and deleted, and does not connect."""
    bundle, claims = lab.registered("verify-rotated"), lab.target.folder / "claims"
    before = claims / f"{bundle.robot}-before"
    shutil.copytree(bundle.folder, before)
    claim = identity.claim(lab.cloud, bundle.robot, out=claims / bundle.robot)
    try:
        provision.renew(bundle.config, claim, status_socket=bundle.folder / "none.sock")
    except IdentityError as error:
        raise InstrumentError(str(error)) from error
    renewed = len(identity.certificates(lab.cloud, bundle.robot))
    time.sleep(CONNECT_AGAIN_S)
    robot = lab.connected(bundle.folder)
    ended = identity.finish_rotation(lab.cloud, bundle.robot, settled_s=0, wait_s=50)
    code = soon_refused(before)
    return {
        "certificates_until_it_settles": renewed,
        "revoked": len(ended),
        "new_one_stays_connected": not robot.lost.is_set(),
        "old_one_connects": code is None,
        "note_code": code,
    }


@question(
    "removal.policy_deleted_after_detach",
    aws="iot-api:API_DeletePolicy",
    expected={"deleted_within_six_minutes": True},
)
def policy_deleted_after_detach(lab: Lab) -> Seen:
    """A detached policy is deleted at once or within five minutes; until then AWS refuses it with
    DeleteConflictException. `make destroy` retries for six."""
    iot, name = lab.client("iot"), f"{lab.namespace}-{lab.name(POLICY)}"
    codes: set[str] = set()

    def deleted() -> bool:
        try:
            iot.delete_policy(policyName=name)
        except iot.exceptions.DeleteConflictException as error:
            codes.add(said_by(error))
            return False
        return True

    made = identity.make_certificate(iot, name)
    lab.undo(identity.once_detached, iot, iot.delete_certificate, certificateId=made.id, forceDelete=True)
    lab.undo(iot.update_certificate, certificateId=made.id, newStatus="REVOKED")
    iot.create_policy(policyName=name, policyDocument=_document(0))
    iot.attach_policy(policyName=name, target=made.arn)
    iot.detach_policy(policyName=name, target=made.arn)
    # Up to six minutes in the worst case that AWS documents: a policy must not stay behind.
    until(deleted, "the deletion of a detached policy", within_s=360)
    return {"deleted_within_six_minutes": True, "note_at_once": not codes, "note_refused_with": sorted(codes)}


@question(
    "removal.robot_removed",
    aws="iot:mqtt iot-api:API_DeleteCertificate",
    expected={"session_ended": True, "connects_again": False},
)
def robot_removed(lab: Lab) -> Seen:
    """`iort robots remove` ends the robot's session and deletes its certificate, its thing and its row in a
    row. The robot does not connect again."""
    name, folder = lab.removed_after("verify-removed")
    bundle = robots.add(lab.cloud, name, out=folder)
    robot = lab.connected(bundle.folder)
    robots.remove(lab.cloud, name)
    ended, code = robot.lost.wait(30), soon_refused(bundle.folder)
    return {"session_ended": ended, "connects_again": code is None, "note_code": code}


@question(
    "removal.certificate_deactivated",
    aws="iot-api:API_UpdateCertificate",
    expected={"connects_before": True, "connects_after": False},
)
def certificate_deactivated(lab: Lab) -> Seen:
    """A certificate that is not active does not connect."""
    bundle = lab.registered("verify-deactivated")
    before = refusal(bundle.folder)
    (certificate,) = identity.certificates(lab.cloud, bundle.robot)
    lab.client("iot").update_certificate(certificateId=certificate.id, newStatus="INACTIVE")
    code = soon_refused(bundle.folder)
    return {"connects_before": before is None, "connects_after": code is None, "note_code": code}


_VERSIONS, _EDITS = 5, 6
_OFTEN = {"Delay": 5, "MaxAttempts": 60}


def _document(number: int) -> str:
    """A policy that nobody uses; each number makes another."""
    statement = {"Effect": "Deny", "Action": ["iot:Connect", f"iot:Publish{'*' * number}"], "Resource": "*"}
    return json.dumps({"Version": "2012-10-17", "Statement": [statement]})


@question(
    "policies.sixth_version",
    aws="iot-api:API_CreatePolicyVersion",
    expected={"versions": _VERSIONS, "sixth": "VersionsLimitExceededException"},
    not_embedded="ministack keeps any number of a policy's versions",
)
def sixth_version(lab: Lab) -> Seen:
    """A policy has at most five versions. A sixth is refused with VersionsLimitExceededException until one of
    them is deleted."""
    iot, name, refused = lab.client("iot"), f"{lab.namespace}-{lab.name(POLICY)}", ""
    iot.create_policy(policyName=name, policyDocument=_document(0))
    lab.undo(iot.delete_policy, policyName=name)
    for number in range(1, _VERSIONS + 1):
        try:
            iot.create_policy_version(policyName=name, policyDocument=_document(number), setAsDefault=True)
        except iot.exceptions.ClientError as error:  # noqa: PERF203 - which of them is refused?
            refused = said_by(error)
    versions = iot.list_policy_versions(policyName=name)["policyVersions"]
    for version in versions:
        if not version["isDefaultVersion"]:
            iot.delete_policy_version(policyName=name, policyVersionId=version["versionId"])
    return {"versions": len(versions), "sixth": refused}


@question(
    "policies.six_edits",
    aws="cfn:aws-resource-iot-policy",
    expected={"edits": ["UPDATE_COMPLETE"] * _EDITS, "at_most_five_versions": True, "newest_holds": True},
)
def six_edits(lab: Lab) -> Seen:
    """CloudFormation changes a policy's document without interruption as often as one likes: that it deletes
    the oldest version, of which AWS IoT holds five, AWS does not document."""
    cloudformation, iot = lab.client("cloudformation"), lab.client("iot")
    name = f"{lab.namespace}-{lab.name(POLICY)}-edited"

    def stack(number: int) -> dict[str, str]:
        policy = {"PolicyName": name, "PolicyDocument": json.loads(_document(number))}
        resources: dict[str, Any] = {"Policy": {"Type": "AWS::IoT::Policy", "Properties": policy}}
        return {"StackName": name, "TemplateBody": json.dumps({"Resources": resources})}

    def wait(what: str) -> None:
        cloudformation.get_waiter(f"stack_{what}_complete").wait(StackName=name, WaiterConfig=_OFTEN)

    edits = []
    cloudformation.create_stack(**stack(0))
    lab.undo(wait, "delete")
    lab.undo(cloudformation.delete_stack, StackName=name)
    wait("create")
    for number in range(1, _EDITS + 1):
        cloudformation.update_stack(**stack(number))
        wait("update")
        (described,) = cloudformation.describe_stacks(StackName=name)["Stacks"]
        edits.append(described["StackStatus"])
    versions = iot.list_policy_versions(policyName=name)["policyVersions"]
    newest = json.loads(iot.get_policy(policyName=name)["policyDocument"])
    return {
        "edits": edits,
        "at_most_five_versions": len(versions) <= _VERSIONS,
        "newest_holds": newest == json.loads(_document(_EDITS)),
    }


@question(
    "removal.connected_robot",
    aws="iot-api:API_DeletePolicy",
    phase=ENDED,
    expected={"session_ended": True, "left_over": []},
    not_embedded="the embedded cloud ends with its process, and has no stacks to destroy then",
)
def connected_robot(lab: Lab) -> Seen:
    """A deployment is taken down while a robot is connected: its session ends with its registration, and no
    stack, policy, object or claim is left over."""
    if lab.target.destroy is None:
        raise CannotAskError("this deployment is somebody's, and stays")
    lab.target.remove_robots(lambda _: None)
    name, folder = lab.removed_after("verify-connected")
    robot = lab.connected(robots.add(lab.cloud, name, out=folder).folder)
    left = lab.target.destroy()
    return {"session_ended": robot.lost.wait(30), "left_over": left}
