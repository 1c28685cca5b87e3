"""What is kept: the telemetry, summary and robots tables."""

from __future__ import annotations

from typing import Any

from aws_cdk import CfnOutput, RemovalPolicy, Stack
from aws_cdk import aws_dynamodb as dynamodb
from constructs import Construct

from contract import EXPIRES_S, ROBOT, SECOND, T_US, TOPIC


class Storage(Stack):
    """Three tables, paid by request. Every topic is a time series: partition key topic, sort key time."""

    def __init__(self, scope: Construct, construct_id: str, **kwargs: Any) -> None:
        super().__init__(scope, construct_id, **kwargs)
        self.telemetry = self._table(
            "Telemetry",
            partition=TOPIC,
            sort=T_US,
            expires=True,
            stream=dynamodb.StreamViewType.NEW_IMAGE,
        )
        self.summary = self._table("Summary", partition=TOPIC, sort=SECOND, expires=True)
        self.robots = self._table("Robots", partition=ROBOT)

    def _table(
        self,
        name: str,
        *,
        partition: str,
        sort: str | None = None,
        expires: bool = False,
        stream: dynamodb.StreamViewType | None = None,
    ) -> dynamodb.Table:
        number, text = dynamodb.AttributeType.NUMBER, dynamodb.AttributeType.STRING
        table = dynamodb.Table(
            self,
            name,
            partition_key=dynamodb.Attribute(name=partition, type=text),
            sort_key=dynamodb.Attribute(name=sort, type=number) if sort else None,
            billing_mode=dynamodb.BillingMode.PAY_PER_REQUEST,
            time_to_live_attribute=EXPIRES_S if expires else None,
            stream=stream,
            removal_policy=RemovalPolicy.DESTROY,
        )
        CfnOutput(self, f"{name}Table", value=table.table_name)
        return table
