"""The key that encrypts stored data: the service's own, or one of the account."""

from __future__ import annotations

from typing import Any

from aws_cdk import ArnFormat, Aws, Duration, Stack
from aws_cdk import aws_dynamodb as dynamodb
from aws_cdk import aws_iam as iam
from aws_cdk import aws_kms as kms
from aws_cdk import aws_s3 as s3
from aws_cdk import aws_sqs as sqs

from stacks.settings import Settings

# A principal that may use the service's resource may use the key through these: decision 11.
SERVICES = ("dynamodb", "s3", "sns", "sqs")


class Encryption:
    """One key for tables, queues, buckets, topics and logs. Without ``key`` each service uses its own.

    The properties are arguments of the constructs: ``sqs.Queue(..., **encryption.queue)``.
    """

    def __init__(self, key: kms.Key | None = None) -> None:
        self.key = key

    @classmethod
    def of(cls, stack: Stack, settings: Settings) -> Encryption:
        """Make the key in a stack if the settings ask for it."""
        if not (settings.customer_key or settings.keep_customer_key):
            return cls()
        key = _key(stack, settings)
        # The other stacks import it until they are updated, after this one.
        stack.export_value(key.key_arn)
        return cls(key if settings.customer_key else None)

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
        # Without reuse, every message would be a request to KMS.
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
        """Arguments of a `sns.Topic`. With SNS' own key, CloudWatch's alarms could not publish."""
        return {} if self.key is None else {"master_key": self.key}


def _key(stack: Stack, settings: Settings) -> kms.Key:
    """Rotated yearly. The account's principals use it through the named services. Services that act by
    themselves use it only for this account's resources, except for CloudWatch's alarms."""
    key = kms.Key(
        stack,
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
