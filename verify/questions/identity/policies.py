"""A policy's versions, and the end of a deployment to which a robot is connected."""

from __future__ import annotations

import json
from typing import Any

from iort_station.fleet import robots
from testkit.mqtt import Robot
from testkit.target import Target
from verify.question import ENDED, CannotAskError, Seen, question
from verify.questions.identity.certificates import POLICY
from verify.tools.robots import removed_after

_CLOUDFORMATION = "https://docs.aws.amazon.com/AWSCloudFormation/latest/TemplateReference"
_API = "https://docs.aws.amazon.com/iot/latest/apireference"
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
