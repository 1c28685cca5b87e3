"""The topic rules, each with its own role, and with the quarantine for failures."""

from __future__ import annotations

from typing import Any

from aws_cdk import Stack
from aws_cdk import aws_iam as iam
from aws_cdk import aws_iot as iot
from aws_cdk import aws_lambda as lambda_
from constructs import Construct

from iort_contract.cloud import pong_template, rule_sql
from iort_contract.topics import PONG, RULE, rule_name
from stacks import iot_core
from stacks.fleet import Fleet
from stacks.processing import Processing
from stacks.quarantine import Quarantine
from stacks.settings import Settings
from stacks.storage import Storage

Action = iot.CfnTopicRule.ActionProperty


class Ingest(Stack):
    """The rules that take messages from the broker. Messages that an action rejects go to the quarantine's
    queue, with their bytes (base64OriginalPayload) and the reason."""

    def __init__(
        self,
        scope: Construct,
        construct_id: str,
        *,
        settings: Settings,
        storage: Storage,
        quarantine: Quarantine,
        processing: Processing,
        fleet: Fleet,
        **kwargs: Any,
    ) -> None:
        super().__init__(scope, construct_id, **kwargs)
        self._settings = settings
        self._rejected = quarantine.rejected
        self.rules = [
            self._record(storage),
            self._lambda_rule("live", processing.live),
            self._pong(),
            self._lambda_rule("echo", processing.echo),
            self._lambda_rule("upload", processing.upload),
            self._lambda_rule("presence", fleet.presence),
            self._lambda_rule("version", fleet.presence),
            self._lambda_rule("fault", processing.alert),
            self._lambda_rule("battery", processing.alert),
        ]

    def _record(self, storage: Storage) -> iot.CfnTopicRule:
        role = self._role("record")
        storage.telemetry.grant(role, "dynamodb:PutItem")
        put = iot.CfnTopicRule.DynamoDBv2ActionProperty(
            role_arn=role.role_arn,
            put_item=iot.CfnTopicRule.PutItemInputProperty(table_name=storage.telemetry.table_name),
        )
        return self._rule("record", role, Action(dynamo_d_bv2=put))

    def _pong(self) -> iot.CfnTopicRule:
        role = self._role("pong")
        topic = f"{PONG}/{self._settings.namespace}/*/{RULE}"
        role.add_to_policy(
            iam.PolicyStatement(
                actions=["iot:Publish"],
                resources=[self.format_arn(service="iot", resource="topic", resource_name=topic)],
            )
        )
        republish = iot.CfnTopicRule.RepublishActionProperty(
            role_arn=role.role_arn, topic=pong_template(self._settings.namespace), qos=0
        )
        return self._rule("pong", role, Action(republish=republish))

    def _lambda_rule(self, name: str, function: lambda_.Function) -> iot.CfnTopicRule:
        action = Action(lambda_=iot.CfnTopicRule.LambdaActionProperty(function_arn=function.function_arn))
        rule = self._rule(name, self._role(name), action)
        iot_core.may_call(self, f"{name.capitalize()}Permission", function, source_arn=rule.attr_arn)
        return rule

    def _role(self, name: str) -> iam.Role:
        role = iot_core.role(self, f"{name.capitalize()}Role")
        self._rejected.grant(role, "sqs:SendMessage")
        return role

    def _rule(self, name: str, role: iam.Role, action: iot.CfnTopicRule.ActionProperty) -> iot.CfnTopicRule:
        retention_s = self._settings.retention_days * 86_400
        rejected = iot.CfnTopicRule.SqsActionProperty(
            queue_url=self._rejected.queue_url, role_arn=role.role_arn, use_base64=False
        )
        rule = iot.CfnTopicRule(
            self,
            name.capitalize(),
            rule_name=rule_name(name, self._settings.namespace),
            topic_rule_payload=iot.CfnTopicRule.TopicRulePayloadProperty(
                sql=rule_sql(
                    name, self._settings.namespace, retention_s, self._settings.thresholds.low_voltage_v
                ),
                aws_iot_sql_version="2016-03-23",
                actions=[action],
                error_action=Action(sqs=rejected),
            ),
        )
        # IoT Core tests the role when it creates the rule, so its policy must exist first.
        rule.node.add_dependency(role)
        return rule
