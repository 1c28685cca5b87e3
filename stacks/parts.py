"""What stacks are made of: their base, the key, functions with their code, queues, schedules and roles.

It knows the settings, and no stack.
"""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import jsii
from aws_cdk import (
    App,
    ArnFormat,
    Aws,
    BundlingOptions,
    CfnOutput,
    CliCredentialsStackSynthesizer,
    DockerImage,
    Duration,
    IgnoreMode,
    ILocalBundling,
    RemovalPolicy,
    Size,
    Stack,
)
from aws_cdk import aws_dynamodb as dynamodb
from aws_cdk import aws_iam as iam
from aws_cdk import aws_kms as kms
from aws_cdk import aws_lambda as lambda_
from aws_cdk import aws_lambda_destinations as destinations
from aws_cdk import aws_logs as logs
from aws_cdk import aws_s3 as s3
from aws_cdk import aws_scheduler as scheduler
from aws_cdk import aws_sqs as sqs

import stacks
from iort_contract.catalog.environments import Environment
from stacks.settings import ALL_LOGS, ROOT, Settings

# A principal that may use the service's resource may use the key through these: decision 11.
SERVICES = ("dynamodb", "s3", "sns", "sqs")


def _removal_policy(settings: Settings) -> RemovalPolicy:
    """Of resources that hold data."""
    return RemovalPolicy.RETAIN if settings.protected else RemovalPolicy.DESTROY


class Encryption:
    """One key for tables, queues, buckets, topics and logs. Without ``key`` each service uses its own.

    The properties are arguments of the constructs: ``sqs.Queue(..., **encryption.queue)``.
    """

    def __init__(self, key: kms.Key | None = None) -> None:
        self.key = key
        self.table: dict[str, Any] = {}
        self.queue: dict[str, Any] = {"encryption": sqs.QueueEncryption.SQS_MANAGED}
        self.bucket: dict[str, Any] = {"encryption": s3.BucketEncryption.S3_MANAGED}
        self.log: dict[str, Any] = {}
        # With SNS' own key, CloudWatch's alarms could not publish.
        self.topic: dict[str, Any] = {}
        if key is not None:
            self.table = {"encryption": dynamodb.TableEncryption.CUSTOMER_MANAGED, "encryption_key": key}
            self.queue = {"encryption": sqs.QueueEncryption.KMS, "encryption_master_key": key}
            self.bucket = {"encryption": s3.BucketEncryption.KMS, "encryption_key": key}
            # Without reuse, every message and object would be a request to KMS.
            self.queue["data_key_reuse"] = Duration.hours(1)
            self.bucket["bucket_key_enabled"] = True
            self.log = {"encryption_key": key}
            self.topic = {"master_key": key}

    @classmethod
    def of(cls, stack: Stack, settings: Settings) -> Encryption:
        """Make the key in a stack if the settings ask for it."""
        if not (settings.customer_key or settings.keep_customer_key):
            return cls()
        key = _key(stack, settings)
        # The other stacks import it until they are updated, after this one.
        stack.export_value(key.key_arn)
        return cls(key if settings.customer_key else None)


def _key(stack: Stack, settings: Settings) -> kms.Key:
    """Rotated yearly. The account's principals use it through the named services. Services that act by
    themselves use it only for this account's resources, except for CloudWatch's alarms."""
    key = kms.Key(
        stack,
        "Key",
        description=f"Encrypts what the deployment {settings.namespace} keeps",
        enable_key_rotation=True,
        pending_window=Duration.days(30 if settings.protected else 7),
        removal_policy=_removal_policy(settings),
    )

    def let(
        sid: str, principal: iam.IPrincipal, actions: list[str], conditions: dict[str, Any] | None = None
    ) -> None:
        key.add_to_resource_policy(
            iam.PolicyStatement(
                sid=sid, principals=[principal], actions=actions, resources=["*"], conditions=conditions
            )
        )

    use = ["kms:Decrypt", "kms:Encrypt", "kms:GenerateDataKey*", "kms:ReEncrypt*", "kms:DescribeKey"]
    through = [f"{service}.{stack.region}.{Aws.URL_SUFFIX}" for service in SERVICES]
    ours = {"kms:CallerAccount": stack.account, "kms:ViaService": through}
    let("ThroughTheServices", iam.AnyPrincipal(), use, {"StringEquals": ours})
    # A table works in the background, by a grant that its creator gives to the service.
    for_aws = {"StringEquals": ours, "Bool": {"kms:GrantIsForAWSResource": True}}
    let("GrantsToTheServices", iam.AnyPrincipal(), ["kms:CreateGrant"], for_aws)
    groups = stack.format_arn(
        service="logs", resource="log-group", resource_name="*", arn_format=ArnFormat.COLON_RESOURCE_NAME
    )
    of_a_group = {"ArnLike": {"kms:EncryptionContext:aws:logs:arn": groups}}
    let("Logs", iam.ServicePrincipal(f"logs.{stack.region}.{Aws.URL_SUFFIX}"), use, of_a_group)
    # Without a condition, as in AWS' example: AWS does not document aws:SourceAccount for an alarm's request.
    # https://repost.aws/knowledge-center/cloudwatch-configure-alarm-sns
    alarms = iam.ServicePrincipal("cloudwatch.amazonaws.com")
    let("Alarms", alarms, ["kms:Decrypt", "kms:GenerateDataKey*"])
    return key


class PlatformStack(Stack):
    """The stack ``<namespace>-<noun>``. The stack storage makes the ``encryption`` of all others."""

    def __init__(self, app: App, noun: str, settings: Settings, encryption: Encryption | None = None) -> None:
        super().__init__(
            app,
            f"{settings.namespace}-{noun}",
            # The embedded cloud knows one caller, not the roles that bootstrapping makes on AWS.
            synthesizer=CliCredentialsStackSynthesizer() if settings.embedded else None,
            termination_protection=settings.protected,
        )
        self.settings = settings
        self.encryption = encryption or Encryption()
        self.removal_policy = _removal_policy(settings)


# Exactly the files that a function imports; see the wiring tests.
FOLDERS = ("functions", "contract/iort_contract", "analysis/iort_analysis")
_CACHES = ("__pycache__", ".mypy_cache", ".ruff_cache")
_EXCLUDES = [
    *("/*", "!/functions"),
    *("!/contract", "/contract/*", "!/contract/iort_contract"),
    *("!/analysis", "/analysis/*", "!/analysis/iort_analysis"),
    *_CACHES,
]


def code() -> lambda_.Code:
    """The asset; its hash is the folders' hash."""
    # The image is never used, since copying always works here.
    bundling = BundlingOptions(image=DockerImage.from_registry("scratch"), local=_SideBySide())
    return lambda_.Code.from_asset(
        str(ROOT), exclude=_EXCLUDES, ignore_mode=IgnoreMode.GIT, bundling=bundling
    )


@jsii.implements(ILocalBundling)
class _SideBySide:
    """Copies the folders instead of building in a container."""

    def try_bundle(self, output_dir: str, *_options: Any, **_more: Any) -> bool:
        for folder in FOLDERS:
            source = ROOT / folder
            shutil.copytree(source, Path(output_dir) / source.name, ignore=shutil.ignore_patterns(*_CACHES))
        return True


RUNTIME = lambda_.Runtime(f"python{stacks.PYTHON}", lambda_.RuntimeFamily.PYTHON)
# The emulator runs functions on its host, so the architecture has no effect there.
ARCHITECTURE = lambda_.Architecture.custom(stacks.ARCHITECTURE)

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
        removal_policy=stack.removal_policy,
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


def arrays(stack: PlatformStack) -> list[lambda_.ILayerVersion]:
    """The arrays of numpy and pyarrow, for functions that archive or analyse; call it once a stack.

    None on the embedded cloud: its functions run on this machine and see the packages of .venv.
    """
    if stack.settings.embedded:
        return []
    code = lambda_.Code.from_asset(str(stack.settings.analysis_layer))
    made = lambda_.LayerVersion(
        stack,
        "Arrays",
        code=code,
        compatible_runtimes=[RUNTIME],
        compatible_architectures=[ARCHITECTURE],
    )
    return [made]


_ATTEMPTS = 5


def queue(
    stack: PlatformStack, name: str, *, reader_timeout_s: int = 0, failures: sqs.IQueue | None = None
) -> sqs.Queue:
    """The stack outputs its address as ``<name>Queue``. After five attempts of a reader with the timeout, a
    message goes to ``failures``."""
    made = sqs.Queue(
        stack,
        name,
        enforce_ssl=True,
        # The maximum.
        retention_period=Duration.days(14),
        removal_policy=stack.removal_policy,
        # AWS advises six times the function's timeout.
        visibility_timeout=Duration.seconds(6 * reader_timeout_s) if reader_timeout_s else None,
        dead_letter_queue=sqs.DeadLetterQueue(max_receive_count=_ATTEMPTS, queue=failures)
        if failures
        else None,
        **stack.encryption.queue,
    )
    CfnOutput(stack, f"{name}Queue", value=made.queue_url)
    return made


def schedules(
    stack: PlatformStack, called: lambda_.Function, when: dict[str, tuple[str, dict[str, Any]]], *, on: bool
) -> None:
    """Call the function by these schedules: an expression of EventBridge Scheduler, and the event, by name.

    The CDK's own target may call every version of a function, too.
    """
    caller = service_role(stack, "ScheduleRole", "scheduler.amazonaws.com")
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


_SERVICE = "iot.amazonaws.com"


def service_role(stack: Stack, construct_id: str, service: str = _SERVICE) -> iam.Role:
    """A role that a service, AWS IoT without one, may assume; it grants nothing yet.

    The service acts for every account; only for ours may it take our role.
    """
    conditions = {"StringEquals": {"aws:SourceAccount": stack.account}}
    return iam.Role(stack, construct_id, assumed_by=iam.ServicePrincipal(service, conditions=conditions))


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
