"""Invariants of every template; `make check` and tests/stacks run them.

They cover gaps of the independent checkers (scripts/check_stacks.py): a wildcard on the actions of a service
that those do not know, a rule without error action, a secret in a function's environment. They cannot be
acknowledged, except by `EVERY_RESOURCE` and `FAMILIES`.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

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
    *(
        ("AuditRole", f"{service}:{action}")
        for service, actions in {
            "cognito-identity": ("GetIdentityPoolRoles",),
            "iam": (
                *("GetPolicy", "GetPolicyVersion", "GetRole", "GetRolePolicy"),
                *("ListAttachedRolePolicies", "ListRolePolicies"),
            ),
            "iot": (
                *("DescribeCACertificate", "DescribeCertificate", "GetEffectivePolicies"),
                *("GetLoggingOptions", "GetPolicy", "GetV2LoggingOptions", "ListCACertificates"),
                *("ListCertificates", "ListPolicies"),
            ),
        }.items()
        for action in actions
    ),
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
