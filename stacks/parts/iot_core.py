"""AWS IoT as a principal: the role that it assumes, and the functions that it may call."""

from __future__ import annotations

from aws_cdk import Stack
from aws_cdk import aws_iam as iam
from aws_cdk import aws_lambda as lambda_

_SERVICE = "iot.amazonaws.com"


def role(stack: Stack, construct_id: str) -> iam.Role:
    """A role that AWS IoT may assume for this account's resources; it grants nothing yet."""
    principal = iam.ServicePrincipal(
        _SERVICE, conditions={"StringEquals": {"aws:SourceAccount": stack.account}}
    )
    return iam.Role(stack, construct_id, assumed_by=principal)


def may_call(
    stack: Stack, construct_id: str, function: lambda_.IFunction, *, source_arn: str
) -> lambda_.CfnPermission:
    """Let a rule or template of this account call a function.

    The permission belongs to ``stack``; in the function's stack it would make the two depend on each other.
    """
    return lambda_.CfnPermission(
        stack,
        construct_id,
        action="lambda:InvokeFunction",
        function_name=function.function_arn,
        principal=_SERVICE,
        source_account=stack.account,
        source_arn=source_arn,
    )
