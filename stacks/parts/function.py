"""A Lambda function of ours: shared code, a role and a log of its own."""

from __future__ import annotations

from typing import Any

from aws_cdk import CfnOutput, Duration, Stack
from aws_cdk import aws_iam as iam
from aws_cdk import aws_lambda as lambda_
from aws_cdk import aws_logs as logs

from stacks.parts import target
from stacks.parts.code import code
from stacks.parts.encryption import Encryption
from stacks.settings import ALL_LOGS, Settings

RUNTIME = lambda_.Runtime(f"python{target.PYTHON}", lambda_.RuntimeFamily.PYTHON)
# The emulator runs functions on its host, so the architecture has no effect there.
ARCHITECTURE = lambda_.Architecture.custom(target.ARCHITECTURE)


def function(
    stack: Stack,
    name: str,
    *,
    settings: Settings,
    encryption: Encryption,
    memory_mb: int,
    timeout_s: int = 10,
    environment: dict[str, str] | None = None,
    layers: list[lambda_.ILayerVersion] | None = None,
    reserved_concurrency: int = 0,
) -> lambda_.Function:
    """The handler of ``functions/<name in lower case>.py``. Its role may only write its own log so far.

    The stack outputs its name as ``<name>Function``. A ``reserved_concurrency`` of 0 reserves nothing.
    """
    log = logs.LogGroup(
        stack,
        f"{name}Log",
        retention=logs.RetentionDays.ONE_MONTH,
        removal_policy=settings.removal_policy,
        **encryption.log,
    )
    # A role of its own instead of AWSLambdaBasicExecutionRole, which may write to every log.
    role = iam.Role(stack, f"{name}Role", assumed_by=iam.ServicePrincipal("lambda.amazonaws.com"))
    log.grant_write(role)
    made = lambda_.Function(
        stack,
        name,
        runtime=RUNTIME,
        architecture=ARCHITECTURE,
        code=code(),
        handler=f"functions.{name.lower()}.handler",
        role=role,
        log_group=log,
        **_logged(settings),
        memory_size=memory_mb,
        timeout=Duration.seconds(timeout_s),
        # functions/shared/metrics.py counts under this namespace.
        environment={"NAMESPACE": settings.namespace, **(environment or {})},
        layers=layers,
        reserved_concurrent_executions=reserved_concurrency or None,
    )
    CfnOutput(stack, f"{name}Function", value=made.function_name)
    return made


def _logged(settings: Settings) -> dict[str, Any]:
    """Lambda's START, END and REPORT lines cost as much as the functions' own lines. Only JSON logs can omit
    them; a failed or timed-out invocation is still reported."""
    if settings.function_logs == ALL_LOGS:
        return {}
    return {
        "logging_format": lambda_.LoggingFormat.JSON,
        "system_log_level_v2": lambda_.SystemLogLevel.WARN,
        # Metric lines have no level, which counts as INFO ("Log-level filtering"); WARN here would drop them.
        "application_log_level_v2": lambda_.ApplicationLogLevel.INFO,
    }
