"""The IoT permissions of a robot and a claim: every statement. test_isolation.py evaluates them."""

from __future__ import annotations

import json
import re

import pytest
from aws_cdk import Stack

from iort_contract.cloud import claim_name, fleet_name
from iort_contract.topics import check_namespace
from stacks.fleet import claim_policy
from stacks.fleet import robot_policy as robots_policy
from tests.stacks.permissions.roles import IOT

ME = "${iot:Connection.Thing.ThingName}"
SHADOW = f"$aws/things/{ME}/shadow/name/agent/*"
SUBSCRIBE = (f"cmd/iort/{ME}/*", f"p?ng/iort/{ME}/*", f"???w*/iort/{ME}/*", "fleet/iort/*", SHADOW)
RECEIVE = (f"*/iort/{ME}/*", "fleet/iort/*")
ROBOT_POLICY = [
    {
        "Effect": "Allow",
        "Action": "iot:Connect",
        "Resource": [f"{IOT}:client/{ME}"],
        "Condition": {"Bool": {"iot:Connection.Thing.IsAttached": ["true"]}},
    },
    {
        "Effect": "Allow",
        "Action": "iot:Publish",
        "Resource": [
            f"{IOT}:topic/$aws/rules/iort_record/dt/iort/{ME}/*",
            f"{IOT}:topic/$aws/rules/iort_live/live/iort/{ME}/*",
            f"{IOT}:topic/?i??/iort/{ME}/*",
            f"{IOT}:topic/fleet/iort/{ME}/*",
            f"{IOT}:topic/ask/iort/{ME}/*",
        ],
    },
    {"Effect": "Allow", "Action": ["iot:Publish", "iot:Receive"], "Resource": [f"{IOT}:topic/{SHADOW}"]},
    {"Effect": "Allow", "Action": "iot:Subscribe", "Resource": [f"{IOT}:topicfilter/{t}" for t in SUBSCRIBE]},
    {"Effect": "Allow", "Action": "iot:Receive", "Resource": [f"{IOT}:topic/{t}" for t in RECEIVE]},
]

# Provisioning with this fleet's template, and receiving the result.
ASKED = ("$aws/certificates/create-from-csr/json", "$aws/provisioning-templates/iort-robot/provision/json")
ANSWERED = [f"{topic}/{answer}" for topic in ASKED for answer in ("accepted", "rejected")]
CLAIM_POLICY = [
    {"Effect": "Allow", "Action": "iot:Connect", "Resource": [f"{IOT}:client/iort-claim-*"]},
    {"Effect": "Allow", "Action": "iot:Publish", "Resource": [f"{IOT}:topic/{topic}" for topic in ASKED]},
    {"Effect": "Allow", "Action": "iot:Subscribe", "Resource": [f"{IOT}:topicfilter/{t}" for t in ANSWERED]},
    {"Effect": "Allow", "Action": "iot:Receive", "Resource": [f"{IOT}:topic/{t}" for t in ANSWERED]},
]


@pytest.fixture(scope="module")
def iot_policies(synthesized, reader):
    return {
        policy["PolicyName"]: [
            {**statement, "Resource": reader.texts(statement["Resource"])}
            for statement in policy["PolicyDocument"]["Statement"]
        ]
        for policy in synthesized.resources("AWS::IoT::Policy").values()
    }


@pytest.fixture(scope="module")
def robot_policy(iot_policies):
    return iot_policies[fleet_name()]


def test_the_iot_policies_have_exactly_these_statements(iot_policies):
    assert iot_policies == {
        fleet_name(): ROBOT_POLICY,
        claim_name(): CLAIM_POLICY,
    }


def test_the_policies_are_within_the_size_limit_in_any_namespace_and_region():
    """ "Policy document size" of AWS IoT Core's quotas: 2048 characters, white space not counted."""
    stack, longest = Stack(), "n" * 16
    real = {"AWS::Partition": "aws-us-gov", "AWS::Region": "ap-southeast-2", "AWS::AccountId": "0" * 12}
    for policy in (robots_policy, claim_policy):
        text = json.dumps(stack.resolve(policy(stack, namespace=check_namespace(longest))))
        joined = json.dumps(_joined(json.loads(text), real), separators=(",", ":"))
        assert longest in joined
        assert len(joined) <= 2048


def _joined(value, real):
    if isinstance(value, list):
        return [_joined(one, real) for one in value]
    if not isinstance(value, dict):
        return value
    if "Ref" in value:
        return real[value["Ref"]]
    if "Fn::Join" in value:
        separator, parts = value["Fn::Join"]
        return separator.join(_joined(parts, real))
    return {key: _joined(one, real) for key, one in value.items()}


def test_every_resource_of_the_robots_policy_is_bound_to_its_thing(robot_policy):
    for statement in robot_policy:
        assert statement["Effect"] == "Allow"
        assert actions(statement) <= {"iot:Connect", "iot:Publish", "iot:Subscribe", "iot:Receive"}
        for resource in statement["Resource"]:
            if ME not in resource:
                assert actions(statement) <= {"iot:Subscribe", "iot:Receive"}
                assert resource.endswith("/fleet/iort/*")
            # A wildcard stands only below the thing's own level, or for the lane of what was subscribed to.
            # No other variable is trusted.
            lanes = {
                f"{IOT}:topic/*/iort/{ME}/*": "iot:Receive",
                f"{IOT}:topicfilter/???w*/iort/{ME}/*": "iot:Subscribe",
            }
            if actions(statement) != {lanes.get(resource)}:
                assert "*" not in resource.removesuffix("/*")
            assert set(re.findall(r"\$\{iot:[^}]*\}", resource)) <= {ME}


def actions(statement):
    given = statement["Action"]
    return {given} if isinstance(given, str) else set(given)
