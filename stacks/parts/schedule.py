"""A schedule that calls a function."""

from __future__ import annotations

from typing import Any

from aws_cdk import aws_iam as iam
from aws_cdk import aws_lambda as lambda_
from aws_cdk import aws_scheduler as scheduler

from stacks.parts.base import PlatformStack


def schedules(
    stack: PlatformStack, called: lambda_.Function, when: dict[str, tuple[str, dict[str, Any]]], *, on: bool
) -> None:
    """Call the function by these schedules: an expression of EventBridge Scheduler, and the event, by name.

    The CDK's own target may call every version of a function, too.
    """
    caller = iam.Role(
        stack,
        "ScheduleRole",
        assumed_by=iam.ServicePrincipal(
            "scheduler.amazonaws.com", conditions={"StringEquals": {"aws:SourceAccount": stack.account}}
        ),
    )
    caller.add_to_policy(
        iam.PolicyStatement(actions=["lambda:InvokeFunction"], resources=[called.function_arn])
    )
    for name, (expression, event) in when.items():
        scheduler.CfnSchedule(
            stack,
            name,
            schedule_expression=expression,
            flexible_time_window={"mode": "OFF"},
            state="ENABLED" if on else "DISABLED",
            target=scheduler.CfnSchedule.TargetProperty(
                arn=called.function_arn, role_arn=caller.role_arn, input=stack.to_json_string(event)
            ),
        )
