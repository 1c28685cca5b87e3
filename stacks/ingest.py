"""The topic rules of the catalogue, each with its own role, and with the quarantine for failures."""

from __future__ import annotations

from collections.abc import Mapping

from aws_cdk import App
from aws_cdk import aws_iam as iam
from aws_cdk import aws_iot as iot
from aws_cdk import aws_lambda as lambda_

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
        role = parts.service_role(self, f"{name}Role")
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
