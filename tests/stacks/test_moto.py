"""A second opinion on the templates: the CDK deploys them into moto's server, an independent emulator.

moto_gaps.py lists the parts that moto does not support."""

from __future__ import annotations

import json
import shutil
import urllib.request
from collections.abc import Mapping
from typing import Any

import boto3
import pytest
from moto import mock_aws
from moto.server import ThreadedMotoServer

from iort_station.cloud import Cloud, without_proxy
from local.deployment import CommandLine
from stacks.variations import VARIATIONS

# The parts of our templates that moto's CloudFormation does not support.

REGION, ACCOUNT = "eu-west-1", "123456789012"

# Types that moto skips with a warning, and why this loses nothing or which test reads them instead. When moto
# supports one, a test fails: remove the type here.
UNKNOWN = {
    "AWS::Budgets::Budget": "moto keeps budgets, but makes none of a template",
    "AWS::CloudFront::Distribution": "moto knows it by CloudFront's API alone",
    "AWS::CloudFront::OriginAccessControl": "moto knows it by CloudFront's API alone",
    "AWS::CloudFront::ResponseHeadersPolicy": "moto knows it by CloudFront's API alone",
    "AWS::CloudWatch::Alarm": "moto makes alarms by CloudWatch's API alone, and of templates only older ones",
    "AWS::IoT::AccountAuditConfiguration": "moto has no Device Defender",
    "AWS::IoT::Logging": "moto's IoT writes no logs",
    "AWS::IoT::ProvisioningTemplate": "moto has no provisioning by claim",
    "AWS::IoT::ScheduledAudit": "moto has no Device Defender",
    "AWS::IoT::ThingGroup": "moto knows it by IoT's API alone",
    "AWS::IoT::TopicRule": "moto knows it by IoT's API alone: test_moto.py hands it every rule",
    "AWS::Lambda::EventInvokeConfig": "moto knows it by Lambda's API alone",
    "AWS::S3::BucketPolicy": "moto knows it by S3's API alone",
    "AWS::Scheduler::Schedule": "moto knows it by the Scheduler's API alone",
    "AWS::SNS::Subscription": "moto knows it by SNS' API alone",
    "AWS::SNS::TopicPolicy": "moto knows it by SNS' API alone",
    "AWS::SQS::QueuePolicy": "moto knows it by SQS' API alone",
}


def without_gaps(template: Mapping[str, Any]) -> dict[str, Any]:
    """The template in a form that moto supports: literals instead of references to missing resources, and
    keys without tags, because moto expects the spelling of KMS' own API."""
    absent = {logical_id for logical_id, r in template["Resources"].items() if r["Type"] in UNKNOWN}

    def replaced(value: Any) -> Any:
        match value:
            case {"Fn::GetAtt": [logical_id, _]} | {"Ref": logical_id} if logical_id in absent:
                return f"arn:aws:iot:{REGION}:{ACCOUNT}:rule/{logical_id}"
            case dict():
                return {key: replaced(one) for key, one in value.items()}
            case list():
                return [replaced(one) for one in value]
        return value

    found: dict[str, Any] = replaced(template)
    for resource in found["Resources"].values():
        if resource["Type"] == "AWS::KMS::Key":
            resource["Properties"].pop("Tags", None)
    return found


def passed_over(formation: Any, stack: str, template: Mapping[str, Any]) -> set[str]:
    """The types of a stack's resources that moto did not make."""
    made = {
        resource["LogicalResourceId"]
        for page in formation.get_paginator("list_stack_resources").paginate(StackName=stack)
        for resource in page["StackResourceSummaries"]
    }
    return {
        resource["Type"]
        for logical_id, resource in template["Resources"].items()
        if logical_id not in made and resource["Type"] != "AWS::CDK::Metadata"
    }


def unknown(templates: Mapping[str, Mapping[str, Any]]) -> set[str]:
    """The resource types in these templates that moto does not support."""
    return {
        one["Type"] for template in templates.values() for one in template["Resources"].values()
    } & UNKNOWN.keys()


# Dev with the defaults, and prod with every option: its own key, mail, budget, site, robot
# metrics, the account's audit and log, the old table.
DEPLOYED = ("default", "everything")


@pytest.fixture(scope="module")
def server():
    """moto's server. It accepts the CDK's bucket names in paths only on localhost."""
    server = ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
    server.start()
    yield f"http://localhost:{server.get_host_and_port()[1]}"
    server.stop()


@pytest.fixture
def cloud(server):
    """An empty account in moto's server."""
    without_proxy("localhost")
    urllib.request.urlopen(urllib.request.Request(f"{server}/moto-api/reset", method="POST")).close()
    # The CDK keeps the account of an access key in the user's home: no other emulator's key.
    return Cloud(endpoint_url=server, region=REGION, access_key_id="moto", secret_access_key="moto")


@pytest.mark.filterwarnings("ignore:Tried to parse")
@pytest.mark.parametrize("name", DEPLOYED)
def test_the_cdk_deploys_every_stack_into_moto(cloud, deployment, tmp_path, name):
    made = deployment(**VARIATIONS[name])
    shutil.copytree(made.folder, tmp_path / "assembly")
    for stack, template in made.stacks.items():
        file = tmp_path / "assembly" / f"{stack}.template.json"
        assert json.loads(file.read_text()) == template
        file.write_text(json.dumps(without_gaps(template)))
    CommandLine(cloud, tmp_path, lambda _step: None).put(tmp_path / "assembly", account=ACCOUNT)
    formation = cloud.client("cloudformation")
    without = set()
    for stack, template in made.stacks.items():
        (description,) = formation.describe_stacks(StackName=stack)["Stacks"]
        assert description["StackStatus"] == "CREATE_COMPLETE"
        without |= passed_over(formation, stack, template)
    assert without == unknown(made.templates)
    tables = cloud.client("dynamodb").list_tables()["TableNames"]
    assert len(tables) == len(_resources(made, "AWS::DynamoDB::Table"))
    for stack, key in _resources(made, "AWS::KMS::Key"):
        _assert_queues_are_encrypted_with(cloud, stack, key)


def _resources(made, kind):
    """Stack's name and logical id to properties of every resource of a type."""
    return {
        (stack, logical_id): one.get("Properties", {})
        for stack, template in made.stacks.items()
        for logical_id, one in template["Resources"].items()
        if one["Type"] == kind
    }


def test_every_gap_of_moto_occurs_in_some_template(deployment):
    met = {kind for name in DEPLOYED for kind in unknown(deployment(**VARIATIONS[name]).templates)}
    assert met == UNKNOWN.keys()
    assert all(UNKNOWN.values())


def test_moto_still_misreads_a_keys_tags():
    """If this fails, `without_gaps` no longer needs to remove the tags."""
    key = {"Type": "AWS::KMS::Key", "Properties": {"KeyPolicy": {}, "Tags": [{"Key": "a", "Value": "b"}]}}
    create = {"StackName": "s", "TemplateBody": json.dumps({"Resources": {"Key": key}})}
    with mock_aws(), pytest.raises(KeyError, match="TagKey"):
        boto3.client("cloudformation", region_name=REGION).create_stack(**create)


def _assert_queues_are_encrypted_with(cloud: Cloud, stack: str, key: str) -> None:
    """moto ignores a table's key."""
    resource = cloud.client("cloudformation").describe_stack_resource(StackName=stack, LogicalResourceId=key)
    number = resource["StackResourceDetail"]["PhysicalResourceId"]
    (arn,) = (one["KeyArn"] for one in cloud.client("kms").list_keys()["Keys"] if one["KeyId"] == number)
    sqs = cloud.client("sqs")
    for url in sqs.list_queues()["QueueUrls"]:
        attributes = sqs.get_queue_attributes(QueueUrl=url, AttributeNames=["KmsMasterKeyId"])
        assert attributes["Attributes"]["KmsMasterKeyId"] == arn


@pytest.mark.parametrize("name", DEPLOYED)
def test_iots_api_accepts_the_topic_rules(cloud, deployment, name):
    """CloudFormation passes a rule to IoT's own API, and botocore validates every shape."""
    iot = cloud.client("iot")
    rules = _resources(deployment(**VARIATIONS[name]), "AWS::IoT::TopicRule")
    for properties in rules.values():
        payload = _literal(_camel_case(properties["TopicRulePayload"]))
        iot.create_topic_rule(ruleName=properties["RuleName"], topicRulePayload=payload)
    kept = {rule["ruleName"] for rule in iot.list_topic_rules()["rules"]}
    assert kept == {properties["RuleName"] for properties in rules.values()}


def _camel_case(value: Any) -> Any:
    """CloudFormation's names as IoT's API spells them."""
    match value:
        case dict():
            return {
                key if key.startswith("Fn::") or key == "Ref" else key[0].lower() + key[1:]: _camel_case(one)
                for key, one in value.items()
            }
        case list():
            return [_camel_case(one) for one in value]
    return value


def _literal(value: Any) -> Any:
    """A text for every intrinsic function."""
    match value:
        case {"Ref": _} | {"Fn::GetAtt": _} | {"Fn::ImportValue": _} | {"Fn::Join": _}:
            return json.dumps(value, sort_keys=True)
        case dict():
            return {key: _literal(one) for key, one in value.items()}
        case list():
            return [_literal(one) for one in value]
    return value
