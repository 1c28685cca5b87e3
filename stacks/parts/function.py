"""A Lambda function of ours: shared code, a role and a log of its own."""

from __future__ import annotations

from typing import Any

from aws_cdk import CfnOutput, Duration, Size
from aws_cdk import aws_iam as iam
from aws_cdk import aws_lambda as lambda_
from aws_cdk import aws_lambda_destinations as destinations
from aws_cdk import aws_logs as logs
from aws_cdk import aws_sqs as sqs

from iort_contract.catalog.environments import Environment
from stacks.parts import target
from stacks.parts.base import PlatformStack
from stacks.parts.code import code
from stacks.settings import ALL_LOGS, Settings

RUNTIME = lambda_.Runtime(f"python{target.PYTHON}", lambda_.RuntimeFamily.PYTHON)
# The emulator runs functions on its host, so the architecture has no effect there.
ARCHITECTURE = lambda_.Architecture.custom(target.ARCHITECTURE)

# numpy's linear algebra; more threads than cores wait for each other, and the waiting is paid.
_ONE_THREAD = {"OPENBLAS_NUM_THREADS": "1"}


def function(
    stack: PlatformStack,
    name: str,
    environment: Environment,
    *,
    memory_mb: int = 256,
    timeout_s: int = 10,
    scratch_mb: int | None = None,
    layers: list[lambda_.ILayerVersion] | None = None,
    reserved_concurrency: int = 0,
    arrays: bool = False,
) -> lambda_.Function:
    """The handler of ``functions/<name in lower case>.py``. Its role may only write its own log so far.

    The stack outputs its name as ``<name>Function``. ``scratch_mb`` is the size of /tmp, 512 without one. A
    ``reserved_concurrency`` of 0 reserves nothing. One that computes with ``arrays`` does so in one thread,
    since it has one core.
    """
    log = logs.LogGroup(
        stack,
        f"{name}Log",
        retention=logs.RetentionDays.ONE_MONTH,
        removal_policy=stack.settings.removal_policy,
        **stack.encryption.log,
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
        **_logged(stack.settings),
        memory_size=memory_mb,
        timeout=Duration.seconds(timeout_s),
        ephemeral_storage_size=Size.mebibytes(scratch_mb) if scratch_mb else None,
        environment={**environment.variables(), **(_ONE_THREAD if arrays else {})},
        layers=layers,
        reserved_concurrent_executions=reserved_concurrency or None,
    )
    CfnOutput(stack, f"{name}Function", value=made.function_name)
    return made


def allow(function_: lambda_.Function, actions: list[str], resource: str) -> None:
    """Grant actions on one resource."""
    function_.add_to_role_policy(iam.PolicyStatement(actions=actions, resources=[resource]))


def invoked_by_rule(
    function_: lambda_.Function, failures: sqs.IQueue, *, age: Duration | None = None, retries: int = 0
) -> None:
    """A rule calls it and does not wait. Its answer is late after 2 s, so by default it is never retried; a
    minute is the shortest age that Lambda allows. It may send to the queue of ``failures``, so that it can
    refuse a message without failing."""
    function_.configure_async_invoke(
        max_event_age=age or Duration.minutes(1),
        retry_attempts=retries,
        on_failure=destinations.SqsDestination(failures),
    )


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
