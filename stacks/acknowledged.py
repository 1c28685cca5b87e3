"""What the independent checkers (cfn-lint, cdk-nag, checkov) ask for and these stacks do not do, and why.

Each finding is acknowledged for one rule on one resource, in the checker's own way: a reviewer who runs
the tools over the templates sees none open. docs/acknowledged.md, generated from this, lists them all.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from aws_cdk import Acknowledgment, App, CfnResource, Stack, Validations
from constructs import IConstruct

from iort_contract import SHADOW
from stacks.settings import Settings

_NAG_PACKS = ("AwsSolutions", "Serverless")


@dataclass(frozen=True)
class Acknowledged:
    """One rule on one resource, or on what is below it."""

    path: str
    rule: str
    reason: str


def acknowledge(app: App, settings: Settings) -> list[Acknowledged]:
    """Tell the checkers; returns what was acknowledged, a resource and rule each."""
    found = [*_of_a_kind(app, settings), *_one_by_one(app, settings)]
    skips: dict[str, tuple[CfnResource, dict[str, str]]] = {}
    for resource, one in found:
        pack = one.rule.split("-")[0]
        if pack in _NAG_PACKS:
            Validations.of(resource).acknowledge(Acknowledgment(id=f"{pack}::{one.rule}", reason=one.reason))
        else:
            skips.setdefault(one.path, (resource, {}))[1][one.rule] = one.reason
    for resource, reasons in skips.values():
        checkov = [{"id": r, "comment": why} for r, why in reasons.items() if r.startswith("CKV")]
        if checkov:
            resource.add_metadata("checkov", {"skip": checkov})
        if lint := [rule for rule in reasons if not rule.startswith("CKV")]:
            resource.add_metadata("cfn-lint", {"config": {"ignore_checks": lint}})
    return [one for _, one in found]


Found = tuple[CfnResource, Acknowledged]


# --- decisions about every resource of a kind -------------------------------------------------------

_FUNCTION = {
    "CKV_AWS_117": "no function needs anything in a VPC, and a way out of one costs more than all the rest",
    "CKV_AWS_173": "the environment holds names and no secret; Lambda encrypts it with its own key",
    "CKV_AWS_116": "what fails goes to the quarantine, by the destination of its mapping or invocation",
    "Serverless-LambdaDLQ": "as CKV_AWS_116: a destination also says why",
    "Serverless-LambdaTracing": "every message carries the time of each hop, and `iort trace` shows them; "
    "X-Ray would see one invocation in twenty",
    "AwsSolutions-L1": "PubNub's SDK names Python 3.13 as the newest that it supports",
    "Serverless-LambdaLatestVersion": "as AwsSolutions-L1",
    "W3005": "the CDK writes the dependency",
}
_OWN_KEY = "encrypted with the service's own key; `customer_key` makes it one of the account's"
_DEV = "stage dev goes with its stacks; stage prod has it"


def _of_a_kind(app: App, settings: Settings) -> Iterator[Found]:
    for resource in _resources(app):
        for rule, reason in _decisions(resource, settings).items():
            yield resource, Acknowledged(_path(resource, settings), rule, reason)


def _decisions(resource: CfnResource, settings: Settings) -> Mapping[str, str]:
    kind = resource.cfn_resource_type
    if kind == "AWS::Lambda::Function":
        return {**_FUNCTION, **_unreserved(resource)}
    decisions: dict[str, str] = {}
    if not settings.customer_key:
        rule = {
            "AWS::DynamoDB::Table": "CKV_AWS_119",
            "AWS::Logs::LogGroup": "CKV_AWS_158",
            "AWS::SQS::Queue": "CKV_AWS_27",
            "AWS::SNS::Topic": "CKV_AWS_26",
        }.get(kind)
        if rule:
            decisions[rule] = _OWN_KEY
    if kind == "AWS::DynamoDB::Table" and not settings.protected:
        decisions |= {"CKV_AWS_28": _DEV, "AwsSolutions-DDB3": _DEV}
    if kind == "AWS::SQS::Queue" and getattr(resource, "redrive_policy", None) is None:
        end = "where messages end that failed elsewhere; an alarm tells a human, who sends them back"
        decisions["Serverless-SQSRedrivePolicy"] = end
    if kind == "AWS::IoT::TopicRule":
        decisions["W3005"] = "IoT Core tries the role when the rule is made, so role and policy come first"
    return decisions


def _unreserved(function: CfnResource) -> Mapping[str, str]:
    if Stack.of(function).resolve(getattr(function, "reserved_concurrent_executions", None)):
        return {}
    return {"CKV_AWS_115": "bounded by what invokes it; reserving takes from the account's other functions"}


# --- one resource at a time ------------------------------------------------------------------------


def _one_by_one(app: App, settings: Settings) -> Iterator[Found]:
    for path, rules in single(settings).items():
        stack, *ids = path.split("/")
        construct: IConstruct | None = app.node.try_find_child(f"{settings.namespace}-{stack}")
        for name in ids:
            construct = construct.node.try_find_child(name) if construct else None
        if construct is None:
            # The stage or a setting leaves it out; that none is left out everywhere is tested.
            continue
        resource = construct if CfnResource.is_cfn_resource(construct) else construct.node.default_child
        for rule, reason in rules.items():
            yield resource, Acknowledged(_path(resource, settings), rule, reason)


def single(settings: Settings) -> dict[str, dict[str, str]]:
    """Stack and construct path to rules and reasons."""
    iot = "arn:<AWS::Partition>:iot:<AWS::Region>:<AWS::AccountId>"
    logs = "arn:<AWS::Partition>:logs:<AWS::Region>:<AWS::AccountId>"

    def wide(resource: str) -> str:
        return f"AwsSolutions-IAM5[Resource::{resource}]"

    a_robot = "the wildcard is the robot, which is known when the message comes"
    to_a_queue = {
        "AwsSolutions-IAM5[Action::kms:GenerateDataKey*]": "the CDK's grant to a queue's sender, one key",
        "AwsSolutions-IAM5[Action::kms:ReEncrypt*]": "as kms:GenerateDataKey*",
    }
    return {
        "account/AuditRole/DefaultPolicy": {wide("*"): "an audit reads every certificate and policy"},
        "account/LogRole/DefaultPolicy": {
            wide(f"{logs}:log-group:AWSIotLogsV2:*"): "the wildcard is the log's streams"
        },
        "account/Audit": {"W3005": "the role's policy must be there before the role is tried"},
        "account/Log": {"W3005": "as account/Audit"},
        "fleet/ProvisioningRole/DefaultPolicy": {
            wide(f"{iot}:thing/*"): "a thing is named by the robot that asks to be provisioned",
            wide(f"{iot}:cert/*"): "a certificate's id is made when it is",
            wide("*"): "RegisterThing and two lists know no resources",
        },
        "fleet/AdmitRole/DefaultPolicy": {
            wide(f"{iot}:cert/*"): "a certificate's id is made when it is; its status alone is read"
        },
        "fleet/Provisioning": {"W3005": "RegisterThing tries role and policy, which must be there first"},
        "fleet/PresenceRole/DefaultPolicy": {**to_a_queue},
        "ingest/PongRole/DefaultPolicy": {wide(f"{iot}:topic/pong/{settings.namespace}/*/rule"): a_robot},
        "processing/EchoRole/DefaultPolicy": {
            wide(f"{iot}:topic/pong/{settings.namespace}/*/lambda"): a_robot,
            **to_a_queue,
        },
        "processing/LiveRole/DefaultPolicy": {**to_a_queue},
        "processing/AlertRole/DefaultPolicy": {**to_a_queue},
        f"processing/Alarms/{settings.alarm_email}": {
            "Serverless-SNSRedrivePolicy": "a mail that is not delivered has nobody to read it from a queue; "
            "the alarm's state stays"
        },
        "processing/UploadRole/DefaultPolicy": {
            wide(f"{settings.namespace}-storage:ExportsOutputFnGetAttFiles8E6940B8ArnD8EE6C03/robots/*"): (
                "the wildcard is the robot, and the function signs for the one that asked"
            ),
            wide(f"{iot}:topic/pong/{settings.namespace}/*/file"): a_robot,
            **to_a_queue,
        },
        "processing/QueryRole/DefaultPolicy": {
            wide(f"{settings.namespace}-storage:ExportsOutputFnGetAttFiles8E6940B8ArnD8EE6C03/results/*"): (
                "the wildcard is the result, which the function names by chance"
            ),
        },
        "processing/SummarizeRole/DefaultPolicy": {
            wide("*"): "dynamodb:ListStreams knows no resources; the CDK grants it with the stream",
            wide(f"{iot}:thing/*/{SHADOW}"): f"{a_robot}; of its shadows this one alone",
            **to_a_queue,
        },
        "processing/LaterRole/DefaultPolicy": {**to_a_queue},
        "processing/PutOffs": {
            "Serverless-LambdaEventSourceMappingDestination": "as quarantine/Rejections: its dead-letter "
            "queue is the quarantine's"
        },
        "quarantine/Rejections": {
            "Serverless-LambdaEventSourceMappingDestination": "a queue's mapping knows none; what fails five "
            "times goes to the queue's own dead-letter queue"
        },
        "site/Page": {
            "AwsSolutions-S1": "CloudFront alone reads it, and what is in it is public by its purpose",
            "CKV_AWS_18": "as AwsSolutions-S1",
            "CKV_AWS_21": "built files, which `iort site` writes again from the repository",
        },
        "site/Distribution": {
            "AwsSolutions-CFR1": "robots are watched from wherever their people are",
            "AwsSolutions-CFR2": "static files without a back end: a firewall has nothing to keep",
            "CKV_AWS_68": "as AwsSolutions-CFR2",
            "AwsSolutions-CFR3": "who reads a public page is nobody's business; CloudWatch counts requests",
            "CKV_AWS_86": "as AwsSolutions-CFR3",
            "AwsSolutions-CFR4": "CloudFront's own certificate decides; with a domain of one's own "
            "TLS 1.2 is the least, as the stack says",
            "CKV_AWS_174": "as AwsSolutions-CFR4",
        },
        "storage/Files": {
            "AwsSolutions-S1": "only robots with pre-signed requests and the operator reach it; CloudTrail's "
            "data events tell who, at $0.10 per 100,000, without a second bucket",
            "CKV_AWS_18": "as AwsSolutions-S1",
            "CKV_AWS_21": "a key is written once and names its content; a version could only be what "
            "somebody threw away",
        },
        "storage/Key": {
            "CKV_AWS_33": "anybody of this account, through the services named only: decision 11"
        },
    }


def _resources(app: App) -> Iterator[CfnResource]:
    for construct in app.node.find_all():
        if CfnResource.is_cfn_resource(construct):
            yield construct


def _path(resource: Any, settings: Settings) -> str:
    return short(resource.node.path, settings.namespace)


def short(path: str, namespace: str) -> str:
    """A construct's path as `Acknowledged` has it: stack and construct ids, the resource's own left out."""
    return path.removeprefix(f"{namespace}-").removesuffix("/Resource")
