"""A second reader of the templates: moto's CloudFormation, which makes every resource that it knows."""

from __future__ import annotations

import io
import json
import os
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import boto3
import pytest
from moto import mock_aws

_REGION, _ACCOUNT = "eu-west-1", "123456789012"
_BUCKET = f"cdk-hnb659fds-assets-{_ACCOUNT}-{_REGION}"
# What moto passes over with a warning. When it learns one, take it off: the test says so.
_UNKNOWN_TO_MOTO = {
    "AWS::CloudWatch::Alarm",
    "AWS::IoT::AccountAuditConfiguration",
    "AWS::IoT::Logging",
    "AWS::IoT::ProvisioningTemplate",
    "AWS::IoT::ScheduledAudit",
    "AWS::IoT::ThingGroup",
    "AWS::IoT::TopicRule",
    "AWS::Lambda::EventInvokeConfig",
    "AWS::S3::BucketPolicy",
    "AWS::SNS::TopicPolicy",
    "AWS::SQS::QueuePolicy",
}
# And what only a production stage has.
_UNKNOWN_OF_PRODUCTION = {"AWS::Budgets::Budget", "AWS::SNS::Subscription"}


@pytest.fixture(params=["synthesized", "production"])
def stage(request):
    """The app of either stage, production with a key of the customer's and all that can be asked for."""
    return request.getfixturevalue(request.param)


@pytest.fixture
def account(monkeypatch, stage):
    """An account in moto, bootstrapped for the CDK, with the app's assets."""
    for name in [name for name in os.environ if name.startswith("AWS_")]:
        monkeypatch.delenv(name)
    monkeypatch.setenv("AWS_DEFAULT_REGION", _REGION)
    with mock_aws():
        boto3.client("ssm").put_parameter(Name="/cdk-bootstrap/hnb659fds/version", Value="30", Type="String")
        s3 = boto3.client("s3")
        s3.create_bucket(Bucket=_BUCKET, CreateBucketConfiguration={"LocationConstraint": _REGION})
        for asset in stage.folder.glob("asset.*"):
            if asset.is_dir():
                s3.put_object(
                    Bucket=_BUCKET, Key=f"{asset.name.removeprefix('asset.')}.zip", Body=_zipped(asset)
                )
        yield


def _zipped(folder: Path) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        for file in filter(Path.is_file, folder.rglob("*")):
            archive.write(file, file.relative_to(folder))
    return buffer.getvalue()


@pytest.mark.filterwarnings("ignore:Tried to parse")
def test_moto_makes_every_stack(account, stage):
    cloudformation = boto3.client("cloudformation")
    unknown = _UNKNOWN_TO_MOTO | (_UNKNOWN_OF_PRODUCTION if stage.protected else set())
    passed_over = set()
    for noun, template in stage.templates.items():
        body = json.dumps(_without_tags_of_keys(_without_references_to(unknown, template)))
        key = f"{noun}.json"
        boto3.client("s3").put_object(Bucket=_BUCKET, Key=key, Body=body)
        stack = f"iort-{noun}"
        cloudformation.create_stack(
            StackName=stack,
            TemplateURL=f"https://{_BUCKET}.s3.{_REGION}.amazonaws.com/{key}",
            Capabilities=["CAPABILITY_NAMED_IAM"],
        )
        (description,) = cloudformation.describe_stacks(StackName=stack)["Stacks"]
        assert description["StackStatus"] == "CREATE_COMPLETE"
        made = {
            resource["LogicalResourceId"]
            for page in cloudformation.get_paginator("list_stack_resources").paginate(StackName=stack)
            for resource in page["StackResourceSummaries"]
        }
        passed_over |= {
            resource["Type"]
            for logical_id, resource in template["Resources"].items()
            if logical_id not in made and resource["Type"] != "AWS::CDK::Metadata"
        }
    assert passed_over == unknown
    tables = boto3.client("dynamodb").list_tables()["TableNames"]
    assert len(tables) == len(stage.resources("AWS::DynamoDB::Table"))
    for key in stage.resources("AWS::KMS::Key"):
        _assert_queues_are_encrypted_with("iort-storage", key)


def _assert_queues_are_encrypted_with(stack: str, key: str) -> None:
    """Of tables, moto passes the key over."""
    resource = boto3.client("cloudformation").describe_stack_resource(StackName=stack, LogicalResourceId=key)
    number = resource["StackResourceDetail"]["PhysicalResourceId"]
    (arn,) = (one["KeyArn"] for one in boto3.client("kms").list_keys()["Keys"] if one["KeyId"] == number)
    sqs = boto3.client("sqs")
    for url in sqs.list_queues()["QueueUrls"]:
        attributes = sqs.get_queue_attributes(QueueUrl=url, AttributeNames=["KmsMasterKeyId"])
        assert attributes["Attributes"]["KmsMasterKeyId"] == arn


def test_topic_rules_are_what_the_api_takes(account, stage):
    """CloudFormation hands a rule on to IoT's own API, of which botocore knows every shape."""
    iot = boto3.client("iot")
    rules = stage.resources("AWS::IoT::TopicRule")
    for properties in rules.values():
        payload = _literal(_camel_case(properties["TopicRulePayload"]))
        iot.create_topic_rule(ruleName=properties["RuleName"], topicRulePayload=payload)
    kept = {rule["ruleName"] for rule in iot.list_topic_rules()["rules"]}
    assert kept == {properties["RuleName"] for properties in rules.values()}


def _without_references_to(kinds: set[str], template: Mapping[str, Any]) -> Any:
    """The template with a literal where it refers to a resource that will not be there."""
    absent = {logical_id for logical_id, r in template["Resources"].items() if r["Type"] in kinds}

    def replaced(value: Any) -> Any:
        match value:
            case {"Fn::GetAtt": [logical_id, _]} | {"Ref": logical_id} if logical_id in absent:
                return f"arn:aws:iot:{_REGION}:{_ACCOUNT}:rule/{logical_id}"
            case dict():
                return {key: replaced(one) for key, one in value.items()}
            case list():
                return [replaced(one) for one in value]
        return value

    return replaced(template)


def _without_tags_of_keys(template: dict[str, Any]) -> dict[str, Any]:
    """moto reads a key's tags as KMS' own API spells them, and not as CloudFormation does."""
    for resource in template["Resources"].values():
        if resource["Type"] == "AWS::KMS::Key":
            resource["Properties"].pop("Tags", None)
    return template


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
