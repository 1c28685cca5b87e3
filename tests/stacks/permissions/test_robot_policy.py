"""The IoT permissions of a robot and a claim: every statement, and its evaluation by IoT Core's rules."""

from __future__ import annotations

import json
import re

import pytest
from aws_cdk import Stack

from iort_contract.catalog.rules import RULES
from iort_contract.cloud import claim_name, fleet_name
from iort_contract.topics import (
    ANSWER,
    ASK,
    BROKER,
    CMD,
    FILE,
    FLEET,
    LIVE,
    PING,
    PING_PATHS,
    PONG,
    RECORD,
    VIEW,
    build_topic,
    check_namespace,
    live_topic,
    record_topic,
    rule_name,
)
from stacks.parts.documents import claim_policy
from stacks.parts.documents import robot_policy as robots_policy
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


def allows(policy, action, kind, topic, thing="car"):
    """IoT Core's rule: * and ? are wildcards in a policy, + and # are plain characters."""
    for statement in policy:
        if f"iot:{action}" not in actions(statement):
            continue
        for resource in statement["Resource"]:
            pattern = re.escape(resource.removeprefix(f"{IOT}:").replace(ME, thing))
            if re.fullmatch(pattern.replace(r"\*", ".*").replace(r"\?", "."), f"{kind}/{topic}"):
                return True
    return False


def test_a_robot_may_publish_on_the_agents_topics_under_its_own_name_only(robot_policy):
    own = [
        record_topic("car", "vesc"),
        live_topic("car", "vesc"),
        build_topic(LIVE, "car", "vesc"),
        build_topic(FLEET, "car", "pose"),
        *(build_topic(PING, "car", path) for path in (*PING_PATHS, FILE)),
        build_topic(ASK, "car", "calibration"),
    ]
    for topic in own:
        assert allows(robot_policy, "Publish", "topic", topic), topic
        for other in ("car2", "ca", "Car", "*", "+", "other/car"):
            assert not allows(robot_policy, "Publish", "topic", topic.replace("/car/", f"/{other}/")), other
        assert not allows(robot_policy, "Publish", "topic", topic, "car2"), topic
        assert not allows(robot_policy, "Publish", "topic", topic.replace("iort", "lab2"))


def test_a_robot_may_not_publish_on_the_topics_of_others(robot_policy):
    for topic in (
        build_topic(CMD, "car", "stop"),
        build_topic(PONG, "car", "rule"),
        build_topic(ANSWER, "car", "calibration"),
        build_topic(VIEW, "car2", "lease"),
        # The record lane costs messaging unless it is sent by Basic Ingest.
        build_topic(RECORD, "car", "vesc"),
        "$aws/things/car/shadow/update",
        "$aws/things/car/shadow/name/other/update",
        "$aws/things/car2/shadow/name/agent/update",
        *(f"$aws/rules/{rule_name(rule)}/dt/iort/car/vesc" for rule in RULES if rule != "record"),
        *(f"$aws/rules/{rule_name(rule)}/live/iort/car/vesc" for rule in RULES if rule != "live"),
    ):
        assert not allows(robot_policy, "Publish", "topic", topic), topic


def test_a_robot_hears_its_own_topics_and_the_fleet(robot_policy):
    for topic_filter in (
        "cmd/iort/car/#",
        "cmd/iort/car/+",
        "pong/iort/car/+",
        "answer/iort/car/+",
        "view/iort/car/lease",
        "fleet/iort/+/#",
        "fleet/iort/car2/pose",
    ):
        assert allows(robot_policy, "Subscribe", "topicfilter", topic_filter), topic_filter
    assert allows(robot_policy, "Subscribe", "topicfilter", build_topic(PING, "car", BROKER))
    for topic_filter in (
        "#",
        "+/iort/car/#",
        "cmd/iort/+/#",
        "cmd/iort/car2/#",
        "pong/iort/+/rule",
        "ping/iort/+/broker",
        "answer/iort/+/calibration",
        "view/iort/car2/lease",
        "view/iort/+/lease",
        "+/aw/iort/car2/x",
        "ask/iort/car/#",
        "dt/iort/car/#",
        "live/iort/car/#",
        "$aws/#",
        "fleet/lab2/+/#",
        "fleet/#",
    ):
        assert not allows(robot_policy, "Subscribe", "topicfilter", topic_filter), topic_filter
    for topic in (
        build_topic(CMD, "car", "stop"),
        build_topic(FLEET, "car2", "pose"),
        build_topic(PONG, "car", "rule"),
        build_topic(ANSWER, "car", "calibration"),
        build_topic(VIEW, "car", "lease"),
    ):
        assert allows(robot_policy, "Receive", "topic", topic), topic
    for topic in (
        build_topic(CMD, "car2", "stop"),
        build_topic(LIVE, "car2", "vesc"),
        build_topic(PONG, "car2", "rule"),
        build_topic(ANSWER, "car2", "calibration"),
        build_topic(VIEW, "car2", "lease"),
    ):
        assert not allows(robot_policy, "Receive", "topic", topic), topic


def test_a_robot_connects_only_as_its_own_thing(robot_policy):
    assert allows(robot_policy, "Connect", "client", "car")
    assert not allows(robot_policy, "Connect", "client", "car2")
    assert not allows(robot_policy, "Connect", "client", "car/2")
