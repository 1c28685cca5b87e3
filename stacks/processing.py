"""The functions that compute: Lambda 1 live, Lambda 2 summarize, and later, echo and upload, each with its
own role and log."""

from __future__ import annotations

import json
from typing import Any

from aws_cdk import CfnOutput, Duration, Stack
from aws_cdk import aws_iam as iam
from aws_cdk import aws_lambda as lambda_
from aws_cdk import aws_lambda_destinations as destinations
from aws_cdk import aws_lambda_event_sources as sources
from aws_cdk import aws_sns as sns
from aws_cdk import aws_sns_subscriptions as subscriptions
from aws_cdk import aws_sqs as sqs
from constructs import Construct

from iort_contract.cloud import RESULTS_PREFIX, pubnub_parameter
from iort_contract.messages.files import FILES_PREFIX
from iort_contract.tables import ALERT_PREFIX, FILES_BYTES, FILES_DAY, STREAMS
from iort_contract.topics import FILE, LAMBDA, PONG, SHADOW
from stacks.function import RUNTIME, function
from stacks.quarantine import Quarantine
from stacks.queue import queue
from stacks.settings import Settings
from stacks.storage import Storage

_SUMMARIZE_S = 60


class Processing(Stack):
    """The functions, with the grants that each one needs."""

    def __init__(
        self,
        scope: Construct,
        construct_id: str,
        *,
        settings: Settings,
        storage: Storage,
        quarantine: Quarantine,
        **kwargs: Any,
    ) -> None:
        super().__init__(scope, construct_id, **kwargs)
        self._settings, self._encryption = settings, storage.encryption
        self._rejected = quarantine.rejected
        self.live = self._live()
        self.put_off = self._put_off()
        self.summarize = self._summarize(storage)
        self.later = self._later(storage)
        self.echo = self._echo()
        self.upload = self._upload(storage)
        self.query = self._query(storage)
        self.alarms = self._alarms()
        self.alert = self._alert(storage)

    def _live(self) -> lambda_.Function:
        name = pubnub_parameter(self._settings.namespace)
        live = function(
            self,
            "Live",
            settings=self._settings,
            encryption=self._encryption,
            memory_mb=256,
            environment={
                "PUBNUB_PARAMETER": name,
                "LIVE_FIELDS": json.dumps(self._settings.live_fields),
                "REJECTED_QUEUE": self._rejected.queue_url,
            },
            layers=[
                lambda_.LayerVersion(
                    self,
                    "PubNub",
                    code=lambda_.Code.from_asset(str(self._settings.layer)),
                    compatible_runtimes=[RUNTIME],
                )
            ],
            reserved_concurrency=self._settings.reserved_for_live,
        )
        self._invoked_once(live)
        parameter = self.format_arn(service="ssm", resource="parameter", resource_name=name.lstrip("/"))
        self._allow(live, ["ssm:GetParameter"], parameter)
        return live

    def _summarize(self, storage: Storage) -> lambda_.Function:
        summarize = self._summarizing("Summarize", storage, PUT_OFF_QUEUE=self.put_off.queue_url)
        self._allow(summarize, ["sqs:SendMessage"], self.put_off.queue_arn)
        # It tells a robot in its shadow that the robot is over its share. AWS IoT: "Action resources".
        shadow = self.format_arn(service="iot", resource="thing", resource_name=f"*/{SHADOW}")
        self._allow(summarize, ["iot:UpdateThingShadow"], shadow)
        summarize.add_event_source(
            sources.DynamoEventSource(
                storage.telemetry,
                starting_position=lambda_.StartingPosition.TRIM_HORIZON,
                # Batches of a robot in the window are read and written once.
                batch_size=500,
                max_batching_window=Duration.seconds(2),
                # With more, two batches of a robot could be summarised at once, and the one that read the
                # table first could write last: docs/processing.md.
                parallelization_factor=1,
                bisect_batch_on_error=True,
                report_batch_item_failures=True,
                retry_attempts=5,
                max_record_age=Duration.hours(6),
                on_failure=sources.SqsDlq(self._rejected),
                # Expired items appear in the stream too; they need no summary.
                filters=[
                    lambda_.FilterCriteria.filter({"eventName": lambda_.FilterRule.is_equal("INSERT")}),
                    lambda_.FilterCriteria.filter({"eventName": lambda_.FilterRule.is_equal("MODIFY")}),
                ],
            )
        )
        return summarize

    def _put_off(self) -> sqs.Queue:
        """The keys of waiting batches, whose robot is over its share of Lambda 2."""
        return queue(
            self,
            "PutOff",
            settings=self._settings,
            encryption=self._encryption,
            # AWS advises six times the function's timeout.
            visibility_timeout=Duration.seconds(6 * _SUMMARIZE_S),
            dead_letter_queue=sqs.DeadLetterQueue(max_receive_count=5, queue=self._rejected),
        )

    def _later(self, storage: Storage) -> lambda_.Function:
        # On the embedded cloud all functions share this machine's cores.
        alone = 1 if self._settings.embedded else 0
        later = self._summarizing("Later", storage, reserved_concurrency=alone)
        storage.telemetry.grant(later, "dynamodb:GetItem")
        self._rejected.grant_send_messages(later)
        self.put_off.grant_consume_messages(later)
        # AWS' minimum: waiting batches take no other function's environments.
        lambda_.EventSourceMapping(
            self,
            "PutOffs",
            target=later,
            event_source_arn=self.put_off.queue_arn,
            batch_size=1,
            max_concurrency=2,
        )
        return later

    def _summarizing(
        self, name: str, storage: Storage, *, reserved_concurrency: int = 0, **environment: str
    ) -> lambda_.Function:
        """A function that reads batches and writes seconds."""
        made = function(
            self,
            name,
            settings=self._settings,
            encryption=self._encryption,
            memory_mb=512,
            timeout_s=_SUMMARIZE_S,
            reserved_concurrency=reserved_concurrency,
            environment={
                "TELEMETRY_TABLE": storage.telemetry.table_name,
                "SUMMARY_TABLE": storage.summary.table_name,
                "ROBOTS_TABLE": storage.robots.table_name,
                "REJECTED_QUEUE": self._rejected.queue_url,
                "ROBOT_METRICS": str(self._settings.robot_metrics).lower(),
                **environment,
            },
        )
        storage.telemetry.grant(made, "dynamodb:Query")
        storage.summary.grant(made, "dynamodb:BatchWriteItem")
        storage.robots.grant(made, "dynamodb:GetItem")
        storage.may_keep(made, STREAMS)
        return made

    def _query(self, storage: Storage) -> lambda_.Function:
        query = function(
            self,
            "Query",
            settings=self._settings,
            encryption=self._encryption,
            # AWS gives a whole core at 1769 MB, and this function only decodes.
            memory_mb=1769,
            # Below the caller's connection timeout; a longer query continues in another invocation.
            timeout_s=18,
            environment={
                "TELEMETRY_TABLE": storage.telemetry.table_name,
                "ROBOTS_TABLE": storage.robots.table_name,
                "FILES_BUCKET": storage.files.bucket_name,
            },
        )
        storage.telemetry.grant(query, "dynamodb:Query", "dynamodb:Scan")
        storage.robots.grant(query, "dynamodb:GetItem")
        # A pre-signed address allows only reads that the function itself may do.
        results = storage.files.arn_for_objects(f"{RESULTS_PREFIX}*")
        self._allow(query, ["s3:GetObject", "s3:PutObject"], results)
        return query

    def _alarms(self) -> sns.Topic:
        """The topic of every alarm and every car's alert."""
        topic = sns.Topic(self, "Alarms", enforce_ssl=True, **self._encryption.topic)
        # A topic with a policy of its own loses the default that lets the account's alarms publish.
        topic.add_to_resource_policy(
            iam.PolicyStatement(
                principals=[iam.ServicePrincipal("cloudwatch.amazonaws.com")],
                actions=["sns:Publish"],
                resources=[topic.topic_arn],
                conditions={"StringEquals": {"aws:SourceAccount": self.account}},
            )
        )
        if self._settings.alarm_email:
            topic.add_subscription(subscriptions.EmailSubscription(self._settings.alarm_email))
        CfnOutput(self, "AlarmTopic", value=topic.topic_arn)
        return topic

    def _alert(self, storage: Storage) -> lambda_.Function:
        alert = function(
            self,
            "Alert",
            settings=self._settings,
            encryption=self._encryption,
            memory_mb=256,
            environment={
                "ROBOTS_TABLE": storage.robots.table_name,
                "ALARM_TOPIC": self.alarms.topic_arn,
                "LOW_VOLTAGE_V": f"{self._settings.thresholds.low_voltage_v:g}",
            },
        )
        storage.may_keep(alert, f"{ALERT_PREFIX}*")
        self._allow(alert, ["sns:Publish"], self.alarms.topic_arn)
        # The car repeats the message within 10 s.
        alert.configure_async_invoke(
            max_event_age=Duration.minutes(5),
            retry_attempts=1,
            on_failure=destinations.SqsDestination(self._rejected),
        )
        return alert

    def _echo(self) -> lambda_.Function:
        echo = function(self, "Echo", settings=self._settings, encryption=self._encryption, memory_mb=256)
        self._invoked_once(echo)
        self._may_answer(echo, f"{PONG}/{self._settings.namespace}/*/{LAMBDA}")
        return echo

    def _upload(self, storage: Storage) -> lambda_.Function:
        upload = function(
            self,
            "Upload",
            settings=self._settings,
            encryption=self._encryption,
            memory_mb=256,
            environment={
                "FILES_BUCKET": storage.files.bucket_name,
                "ROBOTS_TABLE": storage.robots.table_name,
                "REJECTED_QUEUE": self._rejected.queue_url,
                "UPLOAD_BYTES_A_DAY": str(self._settings.upload_gb_a_day * 10**9),
            },
        )
        # The robot asks again if no answer comes.
        self._invoked_once(upload)
        # It can sign only for its own rights. It may neither read a file nor delete one.
        self._allow(
            upload,
            ["s3:AbortMultipartUpload", "s3:ListMultipartUploadParts", "s3:PutObject"],
            storage.files.arn_for_objects(f"{FILES_PREFIX}*"),
        )
        self._allow(upload, ["s3:ListBucket", "s3:ListBucketMultipartUploads"], storage.files.bucket_arn)
        storage.may_keep(upload, FILES_DAY, FILES_BYTES)
        self._may_answer(upload, f"{PONG}/{self._settings.namespace}/*/{FILE}")
        return upload

    def _may_answer(self, one: lambda_.Function, topic: str) -> None:
        self._allow(
            one,
            ["iot:Publish"],
            self.format_arn(service="iot", resource="topic", resource_name=topic),
        )

    @staticmethod
    def _allow(one: lambda_.Function, actions: list[str], resource: str) -> None:
        one.add_to_role_policy(iam.PolicyStatement(actions=actions, resources=[resource]))

    def _invoked_once(self, called: lambda_.Function) -> None:
        """A rule calls it and does not wait. Its answer is late after 2 s (the shortest age that Lambda
        allows is a minute), so it is never retried. It may send to the queue, so that it can refuse a message
        without failing."""
        called.configure_async_invoke(
            max_event_age=Duration.minutes(1),
            retry_attempts=0,
            on_failure=destinations.SqsDestination(self._rejected),
        )
