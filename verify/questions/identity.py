"""Certificates and policies: renewal, removal, versions, and the end of a deployment with a robot."""

from __future__ import annotations

import json
import shutil
import time
from typing import Any

from iort_agent.errors import IdentityError
from iort_agent.verbs import provision
from iort_station.fleet import identity, robots
from testkit.mqtt import CONNECT_AGAIN_S, Robot, refusal, soon_refused
from testkit.target import Target
from testkit.waiting import InstrumentError, until
from verify.question import ENDED, CannotAskError, Seen, question
from verify.tools import registered, removed_after

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


_CLOUDFORMATION = "https://docs.aws.amazon.com/AWSCloudFormation/latest/TemplateReference"
_VERSIONS, _EDITS = 5, 6
_OFTEN = {"Delay": 5, "MaxAttempts": 60}


def _document(number: int) -> str:
    """A policy that nobody uses; each number makes another."""
    statement = {"Effect": "Deny", "Action": ["iot:Connect", f"iot:Publish{'*' * number}"], "Resource": "*"}
    return json.dumps({"Version": "2012-10-17", "Statement": [statement]})


@question(
    "policies.sixth_version",
    expected={"versions": _VERSIONS, "sixth": "VersionsLimitExceededException"},
    source=f"{_API}/API_CreatePolicyVersion.html",
    relied_on_by=("stacks/fleet.py", "verify/preflight/deployed.py"),
    not_embedded="ministack keeps any number of a policy's versions",
)
def sixth_version(target: Target) -> Seen:
    """A policy has at most five versions. A sixth is refused with VersionsLimitExceededException until one of
    them is deleted."""
    iot, name = target.cloud.client("iot"), f"{target.cloud.namespace}-{target.name(POLICY)}"
    refused = ""
    iot.create_policy(policyName=name, policyDocument=_document(0))
    try:
        for number in range(1, _VERSIONS + 1):
            try:
                iot.create_policy_version(
                    policyName=name, policyDocument=_document(number), setAsDefault=True
                )
            except iot.exceptions.ClientError as error:  # noqa: PERF203 - which of them is refused?
                refused = error.response["Error"]["Code"]
        versions = iot.list_policy_versions(policyName=name)["policyVersions"]
        for one in versions:
            if not one["isDefaultVersion"]:
                iot.delete_policy_version(policyName=name, policyVersionId=one["versionId"])
    finally:
        iot.delete_policy(policyName=name)
    return {"versions": len(versions), "sixth": refused}


@question(
    "policies.six_edits",
    expected={"edits": ["UPDATE_COMPLETE"] * _EDITS, "at_most_five_versions": True, "newest_holds": True},
    source=f"{_CLOUDFORMATION}/aws-resource-iot-policy.html",
    relied_on_by=("stacks/fleet.py", "stacks/fleet.py"),
)
def six_edits(target: Target) -> Seen:
    """CloudFormation changes a policy's document without interruption as often as one likes: that it deletes
    the oldest version, of which AWS IoT holds five, AWS does not document."""
    cloudformation, iot = target.cloud.client("cloudformation"), target.cloud.client("iot")
    name = f"{target.cloud.namespace}-{target.name(POLICY)}-edited"

    def stack(number: int) -> dict[str, str]:
        policy = {"PolicyName": name, "PolicyDocument": json.loads(_document(number))}
        resources: dict[str, Any] = {"Policy": {"Type": "AWS::IoT::Policy", "Properties": policy}}
        return {"StackName": name, "TemplateBody": json.dumps({"Resources": resources})}

    def wait(what: str) -> None:
        cloudformation.get_waiter(f"stack_{what}_complete").wait(StackName=name, WaiterConfig=_OFTEN)

    edits = []
    cloudformation.create_stack(**stack(0))
    try:
        wait("create")
        for number in range(1, _EDITS + 1):
            cloudformation.update_stack(**stack(number))
            wait("update")
            (described,) = cloudformation.describe_stacks(StackName=name)["Stacks"]
            edits.append(described["StackStatus"])
        versions = iot.list_policy_versions(policyName=name)["policyVersions"]
        holds = json.loads(iot.get_policy(policyName=name)["policyDocument"])
    finally:
        cloudformation.delete_stack(StackName=name)
        wait("delete")
    return {
        "edits": edits,
        "at_most_five_versions": len(versions) <= _VERSIONS,
        "newest_holds": holds == json.loads(_document(_EDITS)),
    }


@question(
    "removal.connected_robot",
    expected={"session_ended": True, "left_over": []},
    source=f"{_API}/API_DeletePolicy.html",
    phase=ENDED,
    relied_on_by=("scripts/destroy.py", "verify/deployment.py", "station/iort_station/fleet/robots.py"),
    not_embedded="the embedded cloud ends with its process, and has no stacks to destroy then",
)
def connected_robot(target: Target) -> Seen:
    """A deployment is taken down while a robot is connected: its session ends with its registration, and no
    stack, policy, object or claim is left over."""
    if target.destroy is None:
        raise CannotAskError("this deployment is somebody's, and stays")
    target.remove_robots(lambda _: None)
    with (
        removed_after(target, "verify-connected") as (name, folder),
        Robot(robots.add(target.cloud, name, out=folder).folder) as robot,
    ):
        robot.online()
        left = target.destroy()
        ended = robot.lost.wait(30)
    return {"session_ended": ended, "left_over": left}
