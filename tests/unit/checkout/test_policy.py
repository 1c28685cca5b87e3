"""The evaluator of IAM policies behind the isolation table: an example for each of IAM's rules."""

from __future__ import annotations

import pytest

from tests.policy import allows

TOPIC = "arn:aws:iot:eu-west-1:1:topic/"
ME = {"iot:Connection.Thing.ThingName": "car"}


def statement(effect="Allow", action="iot:Publish", resource=f"{TOPIC}a/*", **more):
    return {"Effect": effect, "Action": action, "Resource": resource, **more}


@pytest.mark.parametrize(
    ("names", "returned", "allowed"),
    [
        (["robot", "alert_1"], "NONE", True),
        (["robot", "alert_1", "admit_until_s"], "NONE", False),
        ("alert_2", "NONE", True),
        ("admit_until_s", "NONE", False),
        (["robot"], "ALL_OLD", False),
        (["robot"], None, True),
        (None, None, True),
    ],
)
def test_conditions_on_attributes_are_evaluated(names, returned, allowed):
    condition = {
        "ForAllValues:StringLike": {"dynamodb:Attributes": ["alert_*", "robot"]},
        "StringEqualsIfExists": {"dynamodb:ReturnValues": ["NONE"]},
    }
    asked = {"dynamodb:Attributes": names, "dynamodb:ReturnValues": returned}
    known = {key: value for key, value in asked.items() if value is not None}
    assert allows([statement(Condition=condition)], "iot:Publish", f"{TOPIC}a/b", known) is allowed


@pytest.mark.parametrize(
    ("resource", "topic", "allowed"),
    [
        ("a/b", "a/b", True),
        ("a/b", "a/bc", False),
        ("a/b", "A/b", False),
        ("a/*", "a/b/c", True),
        ("a/*", "a/", True),
        ("a/*", "a", False),
        ("a/?", "a/b", True),
        ("a/?", "a/bc", False),
        # MQTT's wildcards are plain characters.
        ("a/+", "a/b", False),
        ("a/+", "a/+", True),
        ("a/#", "a/b", False),
        ("a/${iot:Connection.Thing.ThingName}/*", "a/car/x", True),
        ("a/${iot:Connection.Thing.ThingName}/*", "a/other/x", False),
        ("a/${iot:Certificate.Subject.CommonName}/*", "a/car/x", False),
        ("a/.*", "a/b", False),
    ],
)
def test_patterns_and_variables_in_resources_are_matched(resource, topic, allowed):
    assert allows([statement(resource=TOPIC + resource)], "iot:Publish", TOPIC + topic, ME) is allowed


def test_a_variables_value_is_not_a_pattern():
    robots = [statement(resource=TOPIC + "a/${iot:Connection.Thing.ThingName}")]
    assert not allows(robots, "iot:Publish", f"{TOPIC}a/b", {"iot:Connection.Thing.ThingName": "*"})


def test_actions_ignore_case_and_may_be_lists():
    assert allows([statement(action="IOT:publish")], "iot:Publish", f"{TOPIC}a/b")
    assert allows([statement(action=["iot:Connect", "iot:Pub*"])], "iot:Publish", f"{TOPIC}a/b")
    assert not allows([statement(action="iot:Publish")], "iot:RetainPublish", f"{TOPIC}a/b")
    assert allows([statement(resource=["x", f"{TOPIC}a/*"])], "iot:Publish", f"{TOPIC}a/b")


def test_a_denial_wins_in_any_order():
    deny = statement("Deny", resource=f"{TOPIC}a/b")
    for order in ([deny, statement()], [statement(), deny]):
        assert not allows(order, "iot:Publish", f"{TOPIC}a/b")
        assert allows(order, "iot:Publish", f"{TOPIC}a/c")
    assert not allows([deny], "iot:Publish", f"{TOPIC}a/c"), "nothing is allowed that is not said"


def test_conditions_are_evaluated():
    attached = statement(Condition={"Bool": {"iot:Connection.Thing.IsAttached": ["true"]}})
    assert allows([attached], "iot:Publish", f"{TOPIC}a/b", {"iot:Connection.Thing.IsAttached": "true"})
    for variables in ({}, {"iot:Connection.Thing.IsAttached": "false"}):
        assert not allows([attached], "iot:Publish", f"{TOPIC}a/b", variables)
    equal = statement(Condition={"StringEquals": {"aws:SourceAccount": "1"}})
    assert allows([equal], "iot:Publish", f"{TOPIC}a/b", {"aws:SourceAccount": "1"})
    assert not allows([equal], "iot:Publish", f"{TOPIC}a/b", {"aws:SourceAccount": "2"})


@pytest.mark.parametrize(
    "unknown",
    [
        {"NotAction": "x"},
        {"NotResource": "x"},
        {"Principal": "*"},
        {"Condition": {"StringLike": {"a": "b"}}},
        {"Effect": "Perhaps"},
    ],
)
def test_an_unknown_element_raises_an_error(unknown):
    with pytest.raises(NotImplementedError):
        allows([{**statement(), **unknown}], "iot:Publish", f"{TOPIC}a/b")
