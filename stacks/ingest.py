"""The topic rules of the catalogue, each with its own role, and with the quarantine for failures."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

import jsii
from aws_cdk import Annotations, App, Aspects, IAspect, Stack
from aws_cdk import aws_iam as iam
from aws_cdk import aws_iot as iot
from aws_cdk import aws_lambda as lambda_
from constructs import IConstruct

from iort_contract.catalog.rules import Republish, Rule, Store
from stacks import parts
from stacks.parts import PlatformStack
from stacks.quarantine import Quarantine
from stacks.settings import Settings
from stacks.storage import Storage

Action = iot.CfnTopicRule.ActionProperty


class Ingest(PlatformStack):
    """The rules that take messages from the broker. Messages that an action rejects go to a queue of the
    quarantine, with their bytes (base64OriginalPayload) and the reason."""

    def __init__(
        self,
        app: App,
        settings: Settings,
        *,
        storage: Storage,
        quarantine: Quarantine,
        functions: Mapping[str, lambda_.Function],
    ) -> None:
        super().__init__(app, "ingest", settings, storage.encryption)
        self._functions = functions
        self._tables = {"telemetry": storage.telemetry}
        self._queues = {"rejected": quarantine.rejected}
        for rule in settings.rules:
            self._rule(rule)

    def _rule(self, rule: Rule) -> None:
        name = rule.name.capitalize()
        role = parts.iot_role(self, f"{name}Role")
        failures = self._queues[rule.error_queue]
        failures.grant(role, "sqs:SendMessage")
        called = None
        if isinstance(rule.action, Store):
            action = self._store(rule.action, role)
        elif isinstance(rule.action, Republish):
            action = self._republish(rule.action, role)
        else:
            called = self._functions[rule.action.function]
            action = Action(lambda_=iot.CfnTopicRule.LambdaActionProperty(function_arn=called.function_arn))
        made = iot.CfnTopicRule(
            self,
            name,
            rule_name=rule.physical_name(self.settings.namespace),
            topic_rule_payload=iot.CfnTopicRule.TopicRulePayloadProperty(
                sql=rule.statement(
                    self.settings.namespace,
                    retention_s=self.settings.retention_s,
                    low_voltage_v=self.settings.low_voltage_v,
                ),
                aws_iot_sql_version="2016-03-23",
                actions=[action],
                error_action=Action(
                    sqs=iot.CfnTopicRule.SqsActionProperty(
                        queue_url=failures.queue_url, role_arn=role.role_arn, use_base64=False
                    )
                ),
            ),
        )
        # IoT Core tests the role when it creates the rule, so its policy must exist first.
        made.node.add_dependency(role)
        if called:
            parts.may_call(self, f"{name}Permission", called, source_arn=made.attr_arn)

    def _store(self, store: Store, role: iam.Role) -> iot.CfnTopicRule.ActionProperty:
        table = self._tables[store.table]
        table.grant(role, "dynamodb:PutItem")
        item = iot.CfnTopicRule.PutItemInputProperty(table_name=table.table_name)
        return Action(
            dynamo_d_bv2=iot.CfnTopicRule.DynamoDBv2ActionProperty(role_arn=role.role_arn, put_item=item)
        )

    def _republish(self, republish: Republish, role: iam.Role) -> iot.CfnTopicRule.ActionProperty:
        namespace = self.settings.namespace
        topics = self.format_arn(
            service="iot", resource="topic", resource_name=republish.topic(namespace, robot="*")
        )
        role.add_to_policy(iam.PolicyStatement(actions=["iot:Publish"], resources=[topics]))
        return Action(
            republish=iot.CfnTopicRule.RepublishActionProperty(
                role_arn=role.role_arn, topic=republish.topic(namespace), qos=0
            )
        )


# The same stacks run on AWS and on the embedded cloud; a rule that only works on one of them is a defect that
# nobody would see, so synth refuses it. The lists are what the pinned ministack and local/emulator/fixes do;
# tests/stacks/test_portable.py holds them against both.

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
