"""The synthesized policies keep the isolation table, by our own evaluator."""

from __future__ import annotations

import json

import pytest
from aws_cdk import Stack

from iort_contract.cloud import claim_name, fleet_name
from iort_contract.topics import FLEET
from stacks.fleet import claim_policy, robot_policy
from stacks.variations import LONGEST_NAMESPACE
from tests.isolation import CLAIM, CONNECT, DRIVER, EVERYBODY, ROBOT, ROWS, SUBSCRIBE, VIEWER, A, B
from tests.policy import allows
from tests.stacks.roles import IOT
from tests.stacks.templates import Reader

ACCOUNT = "arn:aws:iot:eu-west-1:123456789012"
# A certificate is attached to the thing with the client's id, or to no thing.
ATTACHED = {
    "iot:Connection.Thing.ThingName": A,
    "iot:Connection.Thing.IsAttached": "true",
    "iot:ClientId": A,
}


def policies(app):
    """The statements of each role and IoT policy of the fleet by its name, with ARNs of one account."""
    reader, found = Reader(app), {}
    for resource in app.templates["fleet"]["Resources"].values():
        properties = resource.get("Properties", {})
        if "PolicyDocument" in properties:
            name = properties["PolicyName"]
            if resource["Type"] == "AWS::IAM::Policy":
                name = reader.text(properties["Roles"][0])
            found[name] = [
                {**s, "Resource": [arn.replace(IOT, ACCOUNT) for arn in reader.texts(s["Resource"])]}
                for s in properties["PolicyDocument"]["Statement"]
            ]
    return found


@pytest.fixture(scope="module")
def granted(deployment):
    """The statements of everybody in the table."""
    found = policies(deployment(drivers=True, site=True, site_robots=["*"]))
    return {
        ROBOT: found[fleet_name()],
        CLAIM: found[claim_name()],
        VIEWER: found["Viewer"],
        DRIVER: found["Driver"],
        EVERYBODY: found["PublicRole"],
    }


@pytest.mark.parametrize("row", ROWS, ids=lambda row: f"{row.who}-{row.does}-{row.what}")
def test_the_policies_agree_with_the_isolation_table(granted, row):
    statements, action = granted[row.who], f"iot:{row.does}"
    kind = {CONNECT: "client", SUBSCRIBE: "topicfilter"}.get(row.does, "topic")
    arn = f"{ACCOUNT}:{kind}/{row.what}"
    variables = {}
    if row.who == ROBOT and (row.does != CONNECT or row.what == A):
        variables = ATTACHED
        # Every robot hears every fleet message; a client that is no robot cannot connect.
        assert row.what.startswith(f"{FLEET}/") or not allows(statements, action, arn, {})
    assert allows(statements, action, arn, variables) == row.allowed
    assert not allows(statements, action, arn.replace("eu-west-1", "eu-west-2"), variables)


def test_everybody_hears_only_the_robots_of_the_site(deployment):
    statements = policies(deployment(site=True, site_robots=[A]))["PublicRole"]
    for robot, heard in ((A, True), (B, False), ("+", False), (f"{A}-2", False)):
        assert allows(statements, "iot:Subscribe", f"{ACCOUNT}:topicfilter/live/iort/{robot}/+") == heard
        assert allows(statements, "iot:Receive", f"{ACCOUNT}:topic/live/iort/{robot}/vesc") == heard


@pytest.mark.parametrize(
    "action", ["RetainPublish", "UpdateThingShadow", "GetThingShadow", "StartNextPendingJobExecution"]
)
def test_a_robot_may_do_no_other_action(granted, action):
    for statements in (granted[ROBOT], granted[CLAIM]):
        for kind in ("topic", "thing", "client"):
            assert not allows(statements, f"iot:{action}", f"{ACCOUNT}:{kind}/{A}", ATTACHED)


# The longest values of each reference.
LONGEST = {"AWS::Partition": "aws-us-gov", "AWS::Region": "ap-southeast-2", "AWS::AccountId": "0" * 12}


def test_the_policies_are_within_the_size_limit_in_any_namespace_and_region():
    """ "Policy document size" of AWS IoT Core's quotas: 2048 characters, white space not counted."""
    stack = Stack()
    for policy in (robot_policy, claim_policy):
        document = stack.resolve(policy(stack, namespace=LONGEST_NAMESPACE))
        for statement in document["Statement"]:
            statement["Resource"] = [
                "".join(
                    part if isinstance(part, str) else LONGEST[part["Ref"]] for part in arn["Fn::Join"][1]
                )
                for arn in statement["Resource"]
            ]
        text = json.dumps(document, separators=(",", ":"))
        assert LONGEST_NAMESPACE in text
        assert len(text) <= 2048
