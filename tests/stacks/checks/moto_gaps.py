"""The parts of our templates that moto's CloudFormation does not support."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

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
