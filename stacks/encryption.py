"""With whose key the kept data is encrypted: the service's own, or one of the account's."""

from __future__ import annotations

from typing import Any

from aws_cdk import ArnFormat, Aws, Duration, Stack
from aws_cdk import aws_dynamodb as dynamodb
from aws_cdk import aws_iam as iam
from aws_cdk import aws_kms as kms
from aws_cdk import aws_s3 as s3
from aws_cdk import aws_sqs as sqs
from constructs import Construct

from stacks.settings import Settings

# Through these whoever may use the service's resource may use the key: docs/decisions/0011.
SERVICES = ("dynamodb", "s3", "sns", "sqs")


class Encryption:
    """One key for tables, queues, buckets, topics and logs where the settings ask for it; ``key`` is
    None otherwise, and each service encrypts with its own.

    The properties are arguments for the constructs: ``sqs.Queue(..., **encryption.queue)``.
    """

    def __init__(self, scope: Construct, *, settings: Settings) -> None:
        self.key: kms.Key | None = None
        if settings.customer_key or settings.keep_customer_key:
            key = _key(scope, settings)
            # The other stacks import it until they are updated, which is after this one.
            Stack.of(scope).export_value(key.key_arn)
            self.key = key if settings.customer_key else None

    @property
    def table(self) -> dict[str, Any]:
        """Arguments of a `dynamodb.Table`."""
        if self.key is None:
            return {}
        return {"encryption": dynamodb.TableEncryption.CUSTOMER_MANAGED, "encryption_key": self.key}

    @property
    def queue(self) -> dict[str, Any]:
        """Arguments of a `sqs.Queue`."""
        if self.key is None:
            return {"encryption": sqs.QueueEncryption.SQS_MANAGED}
        # Without reuse, every message would be a request to the key.
        return {
            "encryption": sqs.QueueEncryption.KMS,
            "encryption_master_key": self.key,
            "data_key_reuse": Duration.hours(1),
        }

    @property
    def bucket(self) -> dict[str, Any]:
        """Arguments of a `s3.Bucket`."""
        if self.key is None:
            return {"encryption": s3.BucketEncryption.S3_MANAGED}
        return {
            "encryption": s3.BucketEncryption.KMS,
            "encryption_key": self.key,
            "bucket_key_enabled": True,
        }

    @property
    def log(self) -> dict[str, Any]:
        """Arguments of a `logs.LogGroup`."""
        return {} if self.key is None else {"encryption_key": self.key}

    @property
    def topic(self) -> dict[str, Any]:
        """Arguments of a `sns.Topic`. SNS' own key would keep CloudWatch's alarms out."""
        return {} if self.key is None else {"master_key": self.key}


def _key(scope: Construct, settings: Settings) -> kms.Key:
    """Rotated every year. The account's own principals use it through the services named, and the
    services that act by themselves only for this account's resources, but for CloudWatch's alarms."""
    stack = Stack.of(scope)
    key = kms.Key(
        scope,
        "Key",
        description=f"Encrypts what the deployment {settings.namespace} keeps",
        enable_key_rotation=True,
        pending_window=Duration.days(30 if settings.protected else 7),
        removal_policy=settings.removal_policy,
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
    # A table works in the background, with a grant that its maker gives to the service.
    for_aws = {"StringEquals": ours, "Bool": {"kms:GrantIsForAWSResource": True}}
    let("GrantsToTheServices", iam.AnyPrincipal(), ["kms:CreateGrant"], for_aws)
    groups = stack.format_arn(
        service="logs", resource="log-group", resource_name="*", arn_format=ArnFormat.COLON_RESOURCE_NAME
    )
    of_a_group = {"ArnLike": {"kms:EncryptionContext:aws:logs:arn": groups}}
    let("Logs", iam.ServicePrincipal(f"logs.{stack.region}.{Aws.URL_SUFFIX}"), use, of_a_group)
    # Without a condition, as in AWS' example: AWS does not say that an alarm's request has aws:SourceAccount.
    # https://repost.aws/knowledge-center/cloudwatch-configure-alarm-sns
    alarms = iam.ServicePrincipal("cloudwatch.amazonaws.com")
    let("Alarms", alarms, ["kms:Decrypt", "kms:GenerateDataKey*"])
    return key
