"""The checks of `make check` pass on our templates and find faults in others."""

from __future__ import annotations

import json

import pytest

from stacks.checks import EVERY_RESOURCE, broken
from tests.stacks.checks.test_checkers import check_stacks  # noqa: F401 - a fixture


@pytest.mark.parametrize("stage", ["synthesized", "production"])
def test_every_template_passes_the_checks(request, stage):
    for stack, template in request.getfixturevalue(stage).templates.items():
        assert list(broken(template)) == [], stack


def policy(kind="AWS::IAM::Policy", role="LiveRole0123ABCD", **statement):
    document = {"Statement": [{"Effect": "Allow", "Action": "iot:Publish", "Resource": "arn", **statement}]}
    if kind == "AWS::IAM::Role":
        return {"Type": kind, "Properties": {"Policies": [{"PolicyDocument": document}]}}
    return {"Type": kind, "Properties": {"PolicyDocument": document, "Roles": [{"Ref": role}]}}


def function(**variables):
    return {"Type": "AWS::Lambda::Function", "Properties": {"Environment": {"Variables": variables}}}


RULE = {"Type": "AWS::IoT::TopicRule", "Properties": {"TopicRulePayload": {"Sql": "", "Actions": []}}}


@pytest.mark.parametrize(
    ("resource", "checks"),
    [
        (policy(), []),
        (policy(Action="iot:*", Resource="*"), ["wildcard-action", "every-resource"]),
        (policy(Action=["dynamodb:GetItem", "dynamodb:Put*"]), ["wildcard-action"]),
        (policy(Resource=["arn", "*"]), ["every-resource"]),
        (policy(Action="*", Effect="Deny"), []),
        (policy("AWS::IoT::Policy", Action="iot:*"), ["wildcard-action"]),
        (policy("AWS::IAM::ManagedPolicy", Action="s3:*"), ["wildcard-action"]),
        (policy("AWS::IAM::Role", Action="s3:*"), ["wildcard-action"]),
        ({**policy(), "Properties": {"PolicyDocument": {"Statement": [
            {"Effect": "Allow", "NotAction": "iam:*", "Resource": "arn"}]}}}, ["all-but"]),
        (policy(Action="dynamodb:ListStreams", Resource="*"), ["every-resource"]),
        (policy(role="SummarizeRole0123ABCD", Action="dynamodb:ListStreams", Resource="*"), []),
        ({"Type": "AWS::IAM::Role", "Properties": {"ManagedPolicyArns": ["arn"]}}, ["managed-policy"]),
        (RULE, ["error-action"]),
        (function(NAMESPACE="iort"), []),
        (function(API_KEY="x"), ["secret"]),
        (function(PubNubSecret="x"), ["secret"]),
        (function(NAMESPACE="AKIAIOSFODNN7EXAMPLE"), ["secret"]),
        (function(NAMESPACE="sec-c-0a"), ["secret"]),
        ({"Type": "AWS::SSM::Parameter", "Properties": {"Value": "BEGIN RSA PRIVATE KEY"}}, ["secret"]),
    ],
)  # fmt: skip
def test_a_fault_is_found(resource, checks):
    assert [one.check for one in broken({"Resources": {"One": resource}})] == checks


def test_make_check_names_the_path_of_a_fault(check_stacks, tmp_path):  # noqa: F811 - the fixture
    from aws_cdk import App, Stack
    from aws_cdk import aws_iam as iam

    app = App(outdir=str(tmp_path))
    role = iam.Role(Stack(app, "Bad"), "Role", assumed_by=iam.ServicePrincipal("iot.amazonaws.com"))
    role.add_to_policy(iam.PolicyStatement(actions=["iort:*"], resources=["*"]))
    app.synth()
    found = list(check_stacks.own(tmp_path))
    assert [one.text for one in found] == [
        "iort wildcard-action on Bad/Role/DefaultPolicy/Resource: Role may do iort:*",
        "iort every-resource on Bad/Role/DefaultPolicy/Resource: Role may do iort:* on every resource",
        "iort no-such-action on Bad/Role/DefaultPolicy/Resource: there is no action iort:*",
    ]
    assert not any(one.acknowledged for one in found)


def test_every_exception_is_still_needed(synthesized):
    text = json.dumps(synthesized.templates)
    for _, action in EVERY_RESOURCE:
        assert f'"{action}"' in text
