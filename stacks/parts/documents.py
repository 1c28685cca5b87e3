"""The fleet's documents: the rights of a robot and of a claim at the broker, and the provisioning
template."""

from __future__ import annotations

from typing import Any

from aws_cdk import Stack

from iort_contract.cloud import claim_name, fleet_name
from iort_contract.tables import ROBOT_PARAMETER, SERIAL_PARAMETER
from iort_contract.topics import ASK, CMD, FLEET, LIVE, RECORD, SHADOW, rule_name

# A robot's name is its thing name and its client id; the certificate is attached to the thing.
_ME = "${iot:Connection.Thing.ThingName}"
# The policy has no room for each topic by itself, so patterns cover several. In a policy ? is any one
# character, and * any number of them ("Using wildcard characters in MQTT and AWS IoT Core policies").
# A robot subscribes to its pongs, and to its own ping on the path broker.
_PING_OR_PONG = "p?ng"
# Of its own lanes this also allows view: a robot can wake nobody but itself.
_LIVE_OR_PING = "?i??"
# No other lane has a w there.
_ANSWER_OR_VIEW = "???w*"


def provisioning_template(namespace: str) -> dict[str, Any]:
    """The template's body. An existing thing keeps its attributes, and another serial number is refused, so
    that two robots cannot share a name."""
    name = fleet_name(namespace)
    return {
        "Parameters": {ROBOT_PARAMETER: {"Type": "String"}, SERIAL_PARAMETER: {"Type": "String"}},
        "Resources": {
            "certificate": {
                "Type": "AWS::IoT::Certificate",
                "Properties": {"CertificateId": {"Ref": "AWS::IoT::Certificate::Id"}, "Status": "Active"},
            },
            "policy": {"Type": "AWS::IoT::Policy", "Properties": {"PolicyName": name}},
            "thing": {
                "Type": "AWS::IoT::Thing",
                "Properties": {
                    "ThingName": {"Ref": ROBOT_PARAMETER},
                    "ThingTypeName": name,
                    "ThingGroups": [name],
                    "AttributePayload": {"vehicle": "vesc", "serial": {"Ref": SERIAL_PARAMETER}},
                },
                "OverrideSettings": {
                    "AttributePayload": "FAIL",
                    "ThingTypeName": "FAIL",
                    "ThingGroups": "DO_NOTHING",
                },
            },
        },
    }


def claim_policy(stack: Stack, *, namespace: str) -> dict[str, Any]:
    """The IoT policy document of a lasting claim: it allows provisioning with this fleet's template only."""
    asked = (
        "$aws/certificates/create-from-csr/json",
        f"$aws/provisioning-templates/{fleet_name(namespace)}/provision/json",
    )
    answered = [f"{topic}/{answer}" for topic in asked for answer in ("accepted", "rejected")]
    client = f"{claim_name(namespace)}-*"
    return {
        "Version": "2012-10-17",
        "Statement": [
            _allow("iot:Connect", _arns(stack, "client", client)),
            _allow("iot:Publish", _arns(stack, "topic", *asked)),
            _allow("iot:Subscribe", _arns(stack, "topicfilter", *answered)),
            _allow("iot:Receive", _arns(stack, "topic", *answered)),
        ],
    }


def robot_policy(stack: Stack, *, namespace: str) -> dict[str, Any]:
    """The IoT policy document of a robot: its own topics and shadow, and other robots' messages to the fleet.

    AWS allows 2048 characters without white space; a test checks that with the longest names. What a robot
    receives it has subscribed to, so the lanes stand in the statement for subscriptions alone.
    """
    mine = f"{namespace}/{_ME}"
    shadow = f"$aws/things/{_ME}/shadow/name/{SHADOW}"
    publish = (
        # Basic Ingest has the rule in the topic; only these rules are allowed.
        f"$aws/rules/{rule_name('record', namespace)}/{RECORD}/{mine}/*",
        f"$aws/rules/{rule_name('live', namespace)}/{LIVE}/{mine}/*",
        f"{_LIVE_OR_PING}/{mine}/*",
        f"{FLEET}/{mine}/*",
        f"{ASK}/{mine}/*",
    )
    # What every robot hears.
    heard_by_all = (f"{FLEET}/{namespace}/*",)
    subscribe = (
        f"{CMD}/{mine}/*",
        f"{_PING_OR_PONG}/{mine}/*",
        f"{_ANSWER_OR_VIEW}/{mine}/*",
        *heard_by_all,
        f"{shadow}/*",
    )
    return {
        "Version": "2012-10-17",
        "Statement": [
            {
                **_allow("iot:Connect", _arns(stack, "client", _ME)),
                "Condition": {"Bool": {"iot:Connection.Thing.IsAttached": ["true"]}},
            },
            _allow("iot:Publish", _arns(stack, "topic", *publish)),
            _allow(["iot:Publish", "iot:Receive"], _arns(stack, "topic", f"{shadow}/*")),
            _allow("iot:Subscribe", _arns(stack, "topicfilter", *subscribe)),
            _allow("iot:Receive", _arns(stack, "topic", f"*/{mine}/*", *heard_by_all)),
        ],
    }


def _allow(action: str | list[str], resources: list[str]) -> dict[str, Any]:
    return {"Effect": "Allow", "Action": action, "Resource": resources}


def _arns(stack: Stack, kind: str, *names: str) -> list[str]:
    return [stack.format_arn(service="iot", resource=kind, resource_name=name) for name in names]
