"""Refuses at synth every rule that the embedded cloud would accept and silently drop.

The same stacks run on AWS and on the embedded cloud; a rule that only works on one of them is a
defect that nobody would see. The lists are what the pinned ministack and local/gaps/ implement;
tests/stacks/checks/test_portable.py holds them against both.
"""

from __future__ import annotations

import re
from typing import Any

import jsii
from aws_cdk import Annotations, Aspects, IAspect, Stack
from aws_cdk import aws_iot as iot
from constructs import IConstruct

RULE_ACTIONS = frozenset({"lambda", "republish", "dynamoDBv2", "sns", "sqs"})
SQL_FUNCTIONS = frozenset(
    {
        "clientid",
        "encode",
        "floor",
        "isundefined",
        "newuuid",
        "principal",
        "regexp_matches",
        "replace",
        "timestamp",
        "topic",
        "traceid",
    }
)
# What local/patches/republish_topic.patch expands in a republish action's topic.
_TEMPLATE = re.compile(r"\$\{\s*topic\(\s*\d*\s*\)\s*\}")
_CALL = re.compile(r"\b([A-Za-z_]\w*)\s*\(")
# Words that may precede a bracket without being a function.
_KEYWORDS = frozenset(
    {"and", "as", "case", "else", "exists", "in", "not", "or", "select", "then", "when", "where"}
)
_LITERAL = re.compile(r"'(?:[^']|'')*'")


def refuse_what_the_embedded_cloud_drops(scope: IConstruct) -> None:
    """Make synth fail for every topic rule below ``scope`` that the embedded cloud cannot run."""
    Aspects.of(scope).add(_PortableRules())


def sql_functions(sql: str) -> set[str]:
    """The functions that a rule's SQL calls, in lower case."""
    return {name.lower() for name in _CALL.findall(_LITERAL.sub("''", sql))} - _KEYWORDS


def rule_problems(payload: dict[str, Any]) -> list[str]:
    """The parts of a TopicRulePayload (CloudFormation's spelling) that the embedded cloud would drop."""
    problems = [
        f"SQL function {name}() is not implemented"
        for name in sorted(sql_functions(payload["sql"]) - SQL_FUNCTIONS)
    ]
    for action in [*payload.get("actions", []), payload.get("errorAction") or {}]:
        for kind, value in action.items():
            if kind not in RULE_ACTIONS:
                problems.append(f"rule action {kind} is not implemented")
            elif kind == "republish" and "${" in _TEMPLATE.sub("", value["topic"]):
                problems.append(f"republish topic {value['topic']} has a template that is not expanded")
    return problems


@jsii.implements(IAspect)
class _PortableRules:
    def visit(self, node: IConstruct) -> None:
        if not isinstance(node, iot.CfnTopicRule):
            return
        payload = Stack.of(node).resolve(node.topic_rule_payload)
        for problem in rule_problems(payload):
            Annotations.of(node).add_error(f"the embedded cloud would silently drop this: {problem}")
