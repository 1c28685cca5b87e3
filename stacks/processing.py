"""The functions that compute: live, summarize, later, echo, upload, query, alert, incident and answer, each
with its own role and log."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from aws_cdk import App, CfnOutput, Duration
from aws_cdk import aws_iam as iam
from aws_cdk import aws_lambda as lambda_
from aws_cdk import aws_lambda_event_sources as sources
from aws_cdk import aws_sns as sns
from aws_cdk import aws_sns_subscriptions as subscriptions
from aws_cdk import aws_sqs as sqs

from iort_contract.archive import DUE_MS, FIRST_DUE_MS, HOUR
from iort_contract.catalog.environments import (
    AlertEnvironment,
    AnswerEnvironment,
    E,
    EchoEnvironment,
    Environment,
    IncidentEnvironment,
    LaterEnvironment,
    LiveEnvironment,
    QueryEnvironment,
    SummarizeEnvironment,
    UploadEnvironment,
)
from iort_contract.catalog.questions import QUESTIONS
from iort_contract.catalog.rules import Call
from iort_contract.cloud import RESULTS_PREFIX, pubnub_parameter
from iort_contract.messages.files import FILES_PREFIX
from iort_contract.messages.questions import ASK_FOLDER
from iort_contract.tables import (
    ALERT_PREFIX,
    ASKED_PREFIX,
    FILES_BYTES,
    FILES_DAY,
    INCIDENT_PREFIX,
    RECORD_BYTES,
    RECORD_DAY,
    STREAMS,
    TOPIC,
)
from iort_contract.topics import ANSWER, FILE, LAMBDA, PONG, SHADOW
from iort_contract.webhook import webhook_parameter
from stacks.parts import RUNTIME, PlatformStack, allow, arrays, function, invoked_by_rule, queue
from stacks.quarantine import Quarantine
from stacks.settings import LEAST_OF_A_QUEUE, Settings
from stacks.storage import Storage

_SUMMARIZE_S = 60
# Three tries of a webhook, each with its timeouts, and what AWS takes.
_INCIDENT_S = 90


class Processing(PlatformStack):
    """The functions, with the grants that each one needs.

    ``called`` are those of all rules, also of other stacks; one that is not described here needs no grants
    but its log's. ``alarms`` is the topic of every alarm and every car's alert.
    """

    def __init__(
        self,
        app: App,
        settings: Settings,
        *,
        storage: Storage,
        quarantine: Quarantine,
        called: Mapping[str, lambda_.Function],
    ) -> None:
        super().__init__(app, "processing", settings, storage.encryption)
        self._storage, self._rejected = storage, quarantine.rejected
        self.alarms = self._alarms()
        self._incident = self._incidents()
        live = {"live": self._live()} if settings.has_live else {}
        # The keys of waiting batches, whose robot is over its share.
        put_off = queue(self, "PutOff", reader_timeout_s=_SUMMARIZE_S, failures=self._rejected)
        self._summarize(put_off)
        self._later(put_off)
        echo, upload = self._echo(), self._upload()
        self._query()
        self.called = {**called, **live, "echo": echo, "upload": upload, "alert": self._alert()}
        self.called["answer"] = self._answer()
        for rule in settings.rules:
            if isinstance(rule.action, Call) and rule.action.function not in self.called:
                self.called[rule.action.function] = self._plain(rule.action.function)

    def _plain(self, name: str) -> lambda_.Function:
        made = function(self, name.capitalize(), self._environment(Environment))
        invoked_by_rule(made, self._rejected)
        return made

    def _live(self) -> lambda_.Function:
        name = pubnub_parameter(self.settings.namespace)
        layer = lambda_.LayerVersion(
            self,
            "PubNub",
            code=lambda_.Code.from_asset(str(self.settings.layer)),
            compatible_runtimes=[RUNTIME],
        )
        live = function(
            self,
            "Live",
            self._environment(LiveEnvironment, pubnub_parameter=name),
            layers=[layer],
            reserved_concurrency=self.settings.reserved_for_live,
        )
        invoked_by_rule(live, self._rejected)
        allow(live, ["ssm:GetParameter"], self._parameter(name))
        # Its rule imports it only with PubNub, and CloudFormation removes no export before its import.
        self.export_value(live.function_arn)
        return live

    def _summarize(self, put_off: sqs.Queue) -> None:
        environment = self._environment(
            SummarizeEnvironment,
            put_off_queue=put_off.queue_url,
            incident_function=self._incident.function_name,
            record_bytes_a_day=self.settings.record_gb_a_day * 10**9,
        )
        summarize = self._summarizing("Summarize", environment, RECORD_DAY, RECORD_BYTES)
        allow(summarize, ["sqs:SendMessage"], put_off.queue_arn)
        # It tells a robot in its shadow that the robot is over its share. AWS IoT: "Action resources".
        shadow = self.format_arn(service="iot", resource="thing", resource_name=f"*/{SHADOW}")
        allow(summarize, ["iot:UpdateThingShadow"], shadow)
        summarize.add_event_source(
            sources.DynamoEventSource(
                self._storage.telemetry,
                starting_position=lambda_.StartingPosition.TRIM_HORIZON,
                # Batches of a robot in the window are read and written once.
                batch_size=500,
                max_batching_window=Duration.seconds(2),
                # With more, two batches of a robot could be summarised at once, and the one that read the
                # table first could write last: docs/explanation/processing.md.
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

    def _later(self, put_off: sqs.Queue) -> None:
        # On the embedded cloud all functions share this machine's cores.
        alone = 1 if self.settings.embedded else 0
        environment = self._environment(LaterEnvironment, incident_function=self._incident.function_name)
        later = self._summarizing("Later", environment, reserved_concurrency=alone)
        self._storage.telemetry.grant(later, "dynamodb:GetItem")
        self._rejected.grant_send_messages(later)
        put_off.grant_consume_messages(later)
        # Waiting batches take no other function's environments.
        lambda_.EventSourceMapping(
            self,
            "PutOffs",
            target=later,
            event_source_arn=put_off.queue_arn,
            batch_size=1,
            max_concurrency=LEAST_OF_A_QUEUE,
        )

    def _environment(self, kind: type[E], **more: Any) -> E:
        given = {"rejected_queue": self._rejected.queue_url, **more}
        if not self.settings.archive:
            given["archive_table"] = ""
        return self._storage.environment(kind, **given)

    def _summarizing(
        self, name: str, environment: LaterEnvironment, *keeps: str, reserved_concurrency: int = 0
    ) -> lambda_.Function:
        """A function that reads batches and writes seconds; it ``keeps`` these attributes of robots, too."""
        made = function(
            self,
            name,
            environment,
            memory_mb=512,
            timeout_s=_SUMMARIZE_S,
            reserved_concurrency=reserved_concurrency,
        )
        self._storage.telemetry.grant(made, "dynamodb:Query")
        self._storage.summary.grant(made, "dynamodb:BatchWriteItem")
        self._storage.robots.grant(made, "dynamodb:GetItem")
        self._storage.may_keep(made, STREAMS, *keeps)
        # Not by the CDK's grant, which has every version of the function, too.
        allow(made, ["lambda:InvokeFunction"], self._incident.function_arn)
        if self.settings.archive:
            self._storage.may_change(self._storage.archive, made, TOPIC, HOUR, DUE_MS, FIRST_DUE_MS)
        return made

    def _query(self) -> None:
        environment = self._environment(QueryEnvironment)
        # AWS gives a whole core at 1769 MB, and this function only decodes. The timeout is below the caller's
        # connection timeout; a longer query continues in another invocation.
        query = function(self, "Query", environment, memory_mb=1769, timeout_s=18)
        self._storage.telemetry.grant(query, "dynamodb:Query", "dynamodb:Scan")
        self._storage.robots.grant(query, "dynamodb:GetItem")
        # A pre-signed address allows only reads that the function itself may do.
        results = self._storage.files.arn_for_objects(f"{RESULTS_PREFIX}*")
        allow(query, ["s3:GetObject", "s3:PutObject"], results)

    def _alarms(self) -> sns.Topic:
        topic = sns.Topic(self, "Alarms", enforce_ssl=True, **self.encryption.topic)
        # A topic with a policy of its own loses the default that lets the account's alarms publish.
        topic.add_to_resource_policy(
            iam.PolicyStatement(
                principals=[iam.ServicePrincipal("cloudwatch.amazonaws.com")],
                actions=["sns:Publish"],
                resources=[topic.topic_arn],
                conditions={"StringEquals": {"aws:SourceAccount": self.account}},
            )
        )
        if self.settings.alarm_email:
            topic.add_subscription(subscriptions.EmailSubscription(self.settings.alarm_email))
        CfnOutput(self, "AlarmTopic", value=topic.topic_arn)
        return topic

    def _alert(self) -> lambda_.Function:
        alert = function(
            self,
            "Alert",
            self._environment(AlertEnvironment, alarm_topic=self.alarms.topic_arn),
        )
        self._storage.may_keep(alert, f"{ALERT_PREFIX}*")
        allow(alert, ["sns:Publish"], self.alarms.topic_arn)
        # The car repeats the message within 10 s.
        invoked_by_rule(alert, self._rejected, age=Duration.minutes(5), retries=1)
        return alert

    def _incidents(self) -> lambda_.Function:
        name = webhook_parameter(self.settings.namespace)
        environment = self._environment(
            IncidentEnvironment, alarm_topic=self.alarms.topic_arn, webhook_parameter=name
        )
        incident = function(self, "Incident", environment, timeout_s=_INCIDENT_S)
        self._storage.robots.grant(incident, "dynamodb:GetItem")
        self._storage.may_keep(incident, f"{INCIDENT_PREFIX}*")
        allow(incident, ["sns:Publish"], self.alarms.topic_arn)
        allow(incident, ["ssm:GetParameter"], self._parameter(name))
        # Lambda waits a minute before its second attempt, and two before its third.
        invoked_by_rule(incident, self._rejected, age=Duration.minutes(30), retries=2)
        return incident

    def _parameter(self, name: str) -> str:
        return str(self.format_arn(service="ssm", resource="parameter", resource_name=name.lstrip("/")))

    def _echo(self) -> lambda_.Function:
        echo = function(self, "Echo", self._environment(EchoEnvironment))
        invoked_by_rule(echo, self._rejected)
        allow(echo, ["iot:Publish"], self._answers(PONG, LAMBDA))
        return echo

    def _upload(self) -> lambda_.Function:
        files = self._storage.files
        a_day = self.settings.upload_gb_a_day * 10**9
        upload = function(self, "Upload", self._environment(UploadEnvironment, upload_bytes_a_day=a_day))
        # The robot asks again if no answer comes.
        invoked_by_rule(upload, self._rejected)
        # It can sign only for its own rights. It may neither read a file nor delete one.
        signed = ["s3:AbortMultipartUpload", "s3:ListMultipartUploadParts", "s3:PutObject"]
        allow(upload, signed, files.arn_for_objects(f"{FILES_PREFIX}*"))
        allow(upload, ["s3:ListBucket", "s3:ListBucketMultipartUploads"], files.bucket_arn)
        self._storage.may_keep(upload, FILES_DAY, FILES_BYTES)
        allow(upload, ["iot:Publish"], self._answers(PONG, FILE))
        return upload

    def _answer(self) -> lambda_.Function:
        storage, questions = self._storage, QUESTIONS.values()
        answer = function(
            self,
            "Answer",
            self._environment(AnswerEnvironment),
            memory_mb=max(question.memory_mb for question in questions),
            timeout_s=max(question.timeout_s for question in questions),
            layers=arrays(self),
            arrays=True,
        )
        # A robot that waits asks again.
        invoked_by_rule(answer, self._rejected)
        storage.findings.grant(answer, "dynamodb:Query")
        storage.may_keep(answer, f"{ASKED_PREFIX}*")
        allow(answer, ["s3:GetObject"], storage.files.arn_for_objects(f"{FILES_PREFIX}*/{ASK_FOLDER}/*"))
        results = storage.files.arn_for_objects(f"{RESULTS_PREFIX}{ASK_FOLDER}/*")
        allow(answer, ["s3:GetObject", "s3:PutObject"], results)
        allow(answer, ["iot:Publish"], self._answers(ANSWER, "*"))
        return answer

    def _answers(self, lane: str, name: str) -> str:
        """The topics of the answers to all robots."""
        topic = f"{lane}/{self.settings.namespace}/*/{name}"
        return str(self.format_arn(service="iot", resource="topic", resource_name=topic))
