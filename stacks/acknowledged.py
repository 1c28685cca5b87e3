"""The findings of cfn-lint, cdk-nag and checkov that these stacks do not follow, with reasons.

Each finding is acknowledged for one rule on one resource, in the checker's own way, so that the tools report
no open finding. docs/explanation/acknowledged.md is generated from this file.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from aws_cdk import Acknowledgment, App, CfnResource, Stack, Validations
from aws_cdk import aws_iam as iam
from constructs import IConstruct

from iort_contract.messages.live import LEASE
from iort_contract.messages.video import PICTURE, TO, VIDEO
from iort_contract.topics import SHADOW, VIEW
from stacks.settings import Settings

_NAG_PACKS = ("AwsSolutions", "Serverless")


@dataclass(frozen=True)
class Acknowledged:
    """One rule on one resource, or on the resources below it."""

    path: str
    rule: str
    reason: str


def acknowledge(app: App, settings: Settings) -> list[Acknowledged]:
    """Tell the checkers; return each acknowledged rule and resource."""
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
    "CKV_AWS_117": "no function needs a resource in a VPC, and a NAT gateway costs more than all the rest",
    "CKV_AWS_173": "the environment holds names and no secret; Lambda encrypts it with its own key",
    "CKV_AWS_116": "failures go to the quarantine, by the destination of the mapping or invocation",
    "Serverless-LambdaDLQ": "as CKV_AWS_116: a destination also says why",
    "Serverless-LambdaTracing": "every message carries the time of each hop, and `iort trace` shows them; "
    "X-Ray would sample one invocation in twenty",
    "AwsSolutions-L1": "PubNub's SDK supports Python up to 3.13",
    "Serverless-LambdaLatestVersion": "as AwsSolutions-L1",
    "W3005": "the CDK writes the dependency",
}
_OWN_KEY = "encrypted with the service's own key; `customer_key` selects a key of the account"
_OF_A_KEY = {
    "kms:GenerateDataKey*": "the CDK's grant to a queue's sender, one key",
    "kms:ReEncrypt*": "as kms:GenerateDataKey*",
}
_DEV = "stage dev is deleted with its stacks; stage prod has it"


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
        end = "this queue is the last stop; an alarm tells the operator, who sends its messages back"
        decisions["Serverless-SQSRedrivePolicy"] = end
    if isinstance(resource, iam.CfnPolicy):
        granted = str(Stack.of(resource).resolve(resource.policy_document))
        decisions |= {
            f"AwsSolutions-IAM5[Action::{action}]": reason
            for action, reason in _OF_A_KEY.items()
            if action in granted
        }
    if kind == "AWS::IoT::TopicRule":
        decisions["W3005"] = "IoT Core tests the role when it creates the rule, so role and policy come first"
    return decisions


def _unreserved(function: CfnResource) -> Mapping[str, str]:
    if Stack.of(function).resolve(getattr(function, "reserved_concurrent_executions", None)):
        return {}
    return {
        "CKV_AWS_115": "its event sources limit it; a reservation takes from the account's other functions"
    }


# --- one resource at a time ------------------------------------------------------------------------


def _one_by_one(app: App, settings: Settings) -> Iterator[Found]:
    for path, rules in single(settings).items():
        stack, *ids = path.split("/")
        construct: IConstruct | None = app.node.try_find_child(f"{settings.namespace}-{stack}")
        for name in ids:
            construct = construct.node.try_find_child(name) if construct else None
        if construct is None:
            # The stage or a setting leaves it out; a test checks that each one exists in some variation.
            continue
        resource = construct if CfnResource.is_cfn_resource(construct) else construct.node.default_child
        for rule, reason in rules.items():
            yield resource, Acknowledged(_path(resource, settings), rule, reason)


def single(settings: Settings) -> dict[str, dict[str, str]]:
    """Stack and construct path to rules and reasons."""
    iot = "arn:<AWS::Partition>:iot:<AWS::Region>:<AWS::AccountId>"
    logs = "arn:<AWS::Partition>:logs:<AWS::Region>:<AWS::AccountId>"
    states = "arn:<AWS::Partition>:states:<AWS::Region>:<AWS::AccountId>"

    def wide(resource: str) -> str:
        return f"AwsSolutions-IAM5[Resource::{resource}]"

    files = f"{settings.namespace}-storage:ExportsOutputFnGetAttFiles8E6940B8ArnD8EE6C03"
    every_robot = "who may watch or drive may do so with every robot of the fleet"
    a_robot = "the wildcard is the robot, which is known when the message arrives"
    a_run = {wide(f"{files}/analysis/plans/*"): "the wildcard is a run of the analysis, and its robots"}
    read = {wide(f"{files}/archive/*"): "the wildcard is the robot, its stream and the time of a drive"}
    return {
        "analysis/PlanRole/DefaultPolicy": {**a_run, **read},
        "analysis/AnalyseRole/DefaultPolicy": {
            wide(f"{files}/analysis/robot=*"): "the wildcard is the drive, which the event names",
            **read,
        },
        "analysis/EvaluateRole/DefaultPolicy": {
            wide(f"{files}/analysis/*"): "it compares all drives of a robot",
            **a_run,
        },
        "analysis/PresentRole/DefaultPolicy": {
            wide(f"{files}/analysis/robot=*"): "it removes the results of drives that others replace",
            wide(f"{iot}:thing/*/{SHADOW}"): f"{a_robot}; only this one of its shadows",
            **a_run,
        },
        "analysis/MachineRole/DefaultPolicy": {
            **a_run,
            wide("*"): "a delivery of logs takes no resource",
        },
        "analysis/MapPolicy": {
            wide(f"{states}:execution:<Machine6FC8AE80.Name>:*"): "Step Functions names the executions"
        },
        "analysis/Machine": {
            "AwsSolutions-SF1": "its log has every error; the history of executions stays for 90 days",
            "AwsSolutions-SF2": "as Serverless-LambdaTracing of the functions",
            "Serverless-StepFunctionStateMachineXray": "as AwsSolutions-SF2",
            "W3005": "the CDK writes the dependency, and Step Functions tests the role's policy",
        },
        "account/AuditRole/DefaultPolicy": {wide("*"): "an audit reads every certificate and policy"},
        "account/LogRole/DefaultPolicy": {
            wide(f"{logs}:log-group:AWSIotLogsV2:*"): "the wildcard is the log's streams"
        },
        "account/Audit": {"W3005": "the role's policy must exist before AWS tests the role"},
        "account/Log": {"W3005": "as account/Audit"},
        "fleet/ProvisioningRole/DefaultPolicy": {
            wide(f"{iot}:thing/*"): "the robot that asks to be provisioned names its thing",
            wide(f"{iot}:cert/*"): "AWS assigns a certificate's id when it creates it",
            wide("*"): "RegisterThing and two lists take no resources",
        },
        "fleet/AdmitRole/DefaultPolicy": {
            wide(f"{iot}:cert/*"): "AWS assigns a certificate's id later; the function reads only its status"
        },
        "fleet/Provisioning": {"W3005": "RegisterThing tests role and policy, which must exist first"},
        **{
            f"fleet/{person}/DefaultPolicy": {
                wide(
                    f"{iot}:client/{settings.namespace}-{person.lower()}-*"
                ): "every connection has its own id",
                **{
                    wide(f"{iot}:{what}/{settings.namespace}/*"): every_robot
                    for what in ("topicfilter/live", "topic/live", *lanes)
                },
                **{
                    wide(f"{iot}:{kind}/{VIEW}/{settings.namespace}/*/{name}"): every_robot
                    for kind, names in {
                        "topicfilter": (PICTURE,),
                        "topic": (PICTURE, LEASE, VIDEO),
                    }.items()
                    for name in names
                },
                **{
                    wide(f"{iot}:{kind}/{VIEW}/{settings.namespace}/*/{TO}*"): (
                        f"{every_robot}; the last one is the viewer's random name"
                    )
                    for kind in ("topicfilter", "topic")
                },
            }
            for person, lanes in {"Viewer": (), "Driver": ("topic/cmd",)}.items()
        },
        "fleet/PublicRole/DefaultPolicy": {
            wide(f"{iot}:client/{settings.namespace}-viewer-*"): "every connection has its own id",
            **{
                wide(f"{iot}:{what}/live/{settings.namespace}/{robot}/*"): "the wildcard is its stream"
                for robot in settings.site_robots
                for what in ("topicfilter", "topic")
            },
        },
        "fleet/PublicPool": {
            "AwsSolutions-COG7": "a public page has no login; its role may only hear the named robots",
            "CKV_AWS_366": "as AwsSolutions-COG7",
        },
        "ingest/PongRole/DefaultPolicy": {wide(f"{iot}:topic/pong/{settings.namespace}/*/rule"): a_robot},
        "processing/EchoRole/DefaultPolicy": {
            wide(f"{iot}:topic/pong/{settings.namespace}/*/lambda"): a_robot,
        },
        f"processing/Alarms/{settings.alarm_email}": {
            "Serverless-SNSRedrivePolicy": "nobody would read undelivered mails from a queue; "
            "the alarm keeps its state"
        },
        "processing/UploadRole/DefaultPolicy": {
            wide(f"{files}/robots/*"): (
                "the wildcard is the robot, and the function signs only for the robot that asked"
            ),
            wide(f"{iot}:topic/pong/{settings.namespace}/*/file"): a_robot,
        },
        "processing/AnswerRole/DefaultPolicy": {
            wide(f"{files}/robots/*/ask/*"): "the wildcard is the robot, and the function reads its own only",
            wide(f"{files}/results/ask/*"): "the wildcard is the robot that asked, and its question's id",
            wide(f"{iot}:topic/answer/{settings.namespace}/*/*"): f"{a_robot}, and its question",
        },
        "archive/ArchiveRole/DefaultPolicy": {
            wide(f"{files}/archive/*"): "the wildcard is the archive's own objects",
        },
        "archive/Tasks": {
            "Serverless-LambdaEventSourceMappingDestination": "as quarantine/Rejections: its dead-letter "
            "queue is the quarantine's"
        },
        "processing/QueryRole/DefaultPolicy": {
            wide(f"{files}/results/*"): (
                "the wildcard is the result, which the function gives a random name"
            ),
        },
        "processing/SummarizeRole/DefaultPolicy": {
            wide("*"): "dynamodb:ListStreams takes no resources; the CDK grants it with the stream",
            wide(f"{iot}:thing/*/{SHADOW}"): f"{a_robot}; only this one of its shadows",
        },
        "processing/PutOffs": {
            "Serverless-LambdaEventSourceMappingDestination": "as quarantine/Rejections: its dead-letter "
            "queue is the quarantine's"
        },
        "quarantine/Rejections": {
            "Serverless-LambdaEventSourceMappingDestination": "a queue's mapping has no destination; after "
            "five failures a message goes to the queue's own dead-letter queue"
        },
        "site/Page": {
            "AwsSolutions-S1": "only CloudFront reads it, and its content is meant to be public",
            "CKV_AWS_18": "as AwsSolutions-S1",
            "CKV_AWS_21": "built files, which `iort site` writes again from the repository",
        },
        "site/Distribution": {
            "AwsSolutions-CFR1": "people watch robots from anywhere",
            "AwsSolutions-CFR2": "static files without a back end: a firewall has nothing to protect",
            "CKV_AWS_68": "as AwsSolutions-CFR2",
            "AwsSolutions-CFR3": "readers of a public page stay anonymous; CloudWatch counts requests",
            "CKV_AWS_86": "as AwsSolutions-CFR3",
            "AwsSolutions-CFR4": "CloudFront's own certificate decides; with a domain of one's own "
            "TLS 1.2 is the minimum, as the stack says",
            "CKV_AWS_174": "as AwsSolutions-CFR4",
        },
        "storage/Files": {
            "AwsSolutions-S1": "only robots with pre-signed requests and the operator reach it; CloudTrail's "
            "data events log access, at $0.10 per 100,000, without a second bucket",
            "CKV_AWS_18": "as AwsSolutions-S1",
            "CKV_AWS_21": "a key is written once and names its content; a second version could only be a "
            "deleted file",
        },
        "storage/Key": {
            "CKV_AWS_33": "any principal of this account, only through the named services: decision 11"
        },
    }


def _resources(app: App) -> Iterator[CfnResource]:
    for construct in app.node.find_all():
        if CfnResource.is_cfn_resource(construct):
            yield construct


def _path(resource: Any, settings: Settings) -> str:
    return short(resource.node.path, settings.namespace)


def short(path: str, namespace: str) -> str:
    """A construct's path for `Acknowledged`: stack and construct ids, without the resource's own id."""
    return path.removeprefix(f"{namespace}-").removesuffix("/Resource")
