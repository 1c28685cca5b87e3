"""The analysis of drives: the state machine `analysis`, its four functions, and its nightly start.

Robots and Plans find the drives, Drives analyses each one, and Findings compares a robot's, keeps what was
found and mails it; all three are distributed maps: docs/explanation/analysis.md.
"""

from __future__ import annotations

import json

from aws_cdk import App, ArnFormat, CfnOutput, Duration
from aws_cdk import aws_iam as iam
from aws_cdk import aws_lambda as lambda_
from aws_cdk import aws_logs as logs
from aws_cdk import aws_scheduler as scheduler
from aws_cdk import aws_sns as sns
from aws_cdk import aws_stepfunctions as stepfunctions

from iort_contract.archive import ARCHIVE_PREFIX
from iort_contract.catalog.environments import (
    Environment,
    EvaluateEnvironment,
    PlanEnvironment,
    PresentEnvironment,
)
from iort_contract.cloud import ANALYSIS_PREFIX, PLANS_PREFIX
from iort_contract.topics import SHADOW
from stacks.parts import PlatformStack, allow, arrays, function, service_role
from stacks.settings import Settings
from stacks.states import LONGEST_S, states
from stacks.storage import Storage

# Lambda gives a whole core at 1769 MB, and these functions compute. A robot-hour takes two seconds.
_CORE_MB = 1769
_ANALYSE_S, _PLAN_S, _EVALUATE_S = 70, 900, 900
# Every night both days are looked at: a drive that went on at night is analysed whole the next time.
_NIGHTLY_S = 2 * 86_400
# Drives of a robot that a night takes; the rest waits for the next one. A car in a lab makes fifty a day.
# If all of them fail as slowly as they can, that is under six hours of one execution.
_MOST_DRIVES = 100


class Analysis(PlatformStack):
    """The state machine and its functions; serious findings go to the topic ``alarms``."""

    def __init__(self, app: App, settings: Settings, *, storage: Storage, alarms: sns.ITopic) -> None:
        super().__init__(app, "analysis", settings, storage.encryption)
        self._storage, self._alarms = storage, alarms
        self._layers = arrays(self)
        functions = {
            "Plan": self._plan(),
            "Analyse": self._analyse(),
            "Evaluate": self._evaluate(),
            "Present": self._present(),
        }
        self.machine = self._machine(functions)
        CfnOutput(self, "AnalysisMachine", value=self.machine.state_machine_arn)
        if settings.nightly_analysis:
            self._nightly()

    def _plan(self) -> lambda_.Function:
        plan = self._reading("Plan", _PLAN_S)
        self._storage.robots.grant(plan, "dynamodb:Scan")
        self._storage.findings.grant(plan, "dynamodb:Query")
        allow(plan, ["s3:PutObject"], self._objects(PLANS_PREFIX))
        return plan

    def _analyse(self) -> lambda_.Function:
        analyse = self._reading("Analyse", _ANALYSE_S)
        self._storage.findings.grant(analyse, "dynamodb:PutItem")
        allow(analyse, ["s3:PutObject"], self._objects(f"{ANALYSIS_PREFIX}robot="))
        return analyse

    def _evaluate(self) -> lambda_.Function:
        environment = self._storage.environment(EvaluateEnvironment)
        evaluate = self._computing("Evaluate", environment, _EVALUATE_S)
        self._storage.findings.grant(evaluate, "dynamodb:Query")
        allow(evaluate, ["s3:GetObject"], self._objects(ANALYSIS_PREFIX))
        # Without it S3 refuses (403) instead of saying that a robot has no plan, because that failed.
        allow(evaluate, ["s3:ListBucket"], self._storage.files.bucket_arn)
        allow(evaluate, ["s3:PutObject"], self._objects(PLANS_PREFIX))
        return evaluate

    def _present(self) -> lambda_.Function:
        environment = self._storage.environment(PresentEnvironment, alarm_topic=self._alarms.topic_arn)
        present = function(self, "Present", environment, timeout_s=_EVALUATE_S)
        self._storage.findings.grant(present, "dynamodb:Query", "dynamodb:PutItem", "dynamodb:DeleteItem")
        allow(present, ["s3:GetObject"], self._objects(PLANS_PREFIX))
        # The results of a drive that others replace.
        allow(present, ["s3:ListBucket"], self._storage.files.bucket_arn)
        allow(present, ["s3:DeleteObject"], self._objects(f"{ANALYSIS_PREFIX}robot="))
        allow(present, ["sns:Publish"], self._alarms.topic_arn)
        # A robot with a trigger on findings is to keep what its ring has of the evidence.
        shadow = self.format_arn(service="iot", resource="thing", resource_name=f"*/{SHADOW}")
        allow(present, ["iot:GetThingShadow", "iot:UpdateThingShadow"], shadow)
        return present

    def _computing(self, name: str, environment: Environment, timeout_s: int) -> lambda_.Function:
        """A function with numpy and a core of its own."""
        return function(
            self,
            name,
            environment,
            memory_mb=_CORE_MB,
            timeout_s=timeout_s,
            layers=self._layers,
            arrays=True,
        )

    def _reading(self, name: str, timeout_s: int) -> lambda_.Function:
        """One that also reads what robots recorded."""
        reading = self._computing(name, self._storage.environment(PlanEnvironment), timeout_s)
        self._storage.telemetry.grant(reading, "dynamodb:Query")
        self._storage.archive.grant(reading, "dynamodb:Query")
        allow(reading, ["s3:GetObject"], self._objects(ARCHIVE_PREFIX))
        self._storage.robots.grant(reading, "dynamodb:GetItem")
        return reading

    def _objects(self, prefix: str) -> str:
        return str(self._storage.files.arn_for_objects(f"{prefix}*"))

    def _machine(self, functions: dict[str, lambda_.Function]) -> stepfunctions.StateMachine:
        role = service_role(self, "MachineRole", "states.amazonaws.com")

        def may(actions: list[str], resources: list[str]) -> None:
            role.add_to_policy(iam.PolicyStatement(actions=actions, resources=resources))

        may(["lambda:InvokeFunction"], [one.function_arn for one in functions.values()])
        # The map lists the plans of its run, and reads them.
        may(["s3:ListBucket"], [self._storage.files.bucket_arn])
        may(["s3:GetObject"], [self._objects(PLANS_PREFIX)])
        definition = states(
            self.partition,
            {name: one.function_arn for name, one in functions.items()},
            bucket=self._storage.files.bucket_name,
            at_once=self.settings.at_once,
        )
        machine = stepfunctions.StateMachine(
            self,
            "Machine",
            role=role,
            definition_body=stepfunctions.DefinitionBody.from_string(json.dumps(definition)),
            timeout=Duration.seconds(LONGEST_S),
            logs=stepfunctions.LogOptions(
                destination=logs.LogGroup(
                    self,
                    "MachineLog",
                    retention=logs.RetentionDays.ONE_MONTH,
                    removal_policy=self.removal_policy,
                    **self.encryption.log,
                ),
                # With the errors of every child, and without what it was given.
                level=stepfunctions.LogLevel.ERROR,
                include_execution_data=False,
            ),
        )
        # The map's children are executions of the machine itself, which is made after its role: "IAM policies
        # for using Distributed Map states".
        children = iam.Policy(self, "MapPolicy", roles=[role])
        children.add_statements(
            iam.PolicyStatement(actions=["states:StartExecution"], resources=[machine.state_machine_arn]),
            iam.PolicyStatement(
                actions=["states:DescribeExecution", "states:StopExecution"],
                resources=[
                    self.format_arn(
                        service="states",
                        resource="execution",
                        resource_name=f"{machine.state_machine_name}:*",
                        arn_format=ArnFormat.COLON_RESOURCE_NAME,
                    )
                ],
            ),
        )
        return machine

    def _nightly(self) -> None:
        role = service_role(self, "NightlyRole", "scheduler.amazonaws.com")
        self.machine.grant_start_execution(role)
        scheduler.CfnSchedule(
            self,
            "Nightly",
            flexible_time_window=scheduler.CfnSchedule.FlexibleTimeWindowProperty(mode="OFF"),
            schedule_expression="cron(0 3 * * ? *)",
            target=scheduler.CfnSchedule.TargetProperty(
                arn=self.machine.state_machine_arn,
                role_arn=role.role_arn,
                input=json.dumps({"robots": [], "last_s": _NIGHTLY_S, "most": _MOST_DRIVES}),
            ),
        )
