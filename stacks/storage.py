"""The tables of telemetry, summary, robots, archive, quarantine and findings, and the files' bucket."""

from __future__ import annotations

from dataclasses import fields
from typing import Any

from aws_cdk import App, CfnOutput, Duration
from aws_cdk import aws_dynamodb as dynamodb
from aws_cdk import aws_iam as iam
from aws_cdk import aws_s3 as s3

from iort_contract.archive import ARCHIVE_PREFIX, HOUR
from iort_contract.catalog.environments import E
from iort_contract.cloud import PLANS_PREFIX, RESULTS_PREFIX
from iort_contract.messages.files import FILES_PREFIX
from iort_contract.tables import BATCH, ENTRY, EXPIRES_S, FINDING, ROBOT, SECOND, TOPIC
from stacks.parts import Encryption, PlatformStack
from stacks.settings import Settings

# Storage at half the price, reads at a cent a gigabyte. S3 allows the move from this day on, and does not
# move objects below 128 KB, which it would make dearer.
_RARE_AFTER_DAYS = 30
# How long a deleted or replaced object can be restored in `prod`: docs/how-to/restore.md.
VERSIONS_DAYS = 30
_TEXT = dynamodb.AttributeType.STRING


class Storage(PlatformStack):
    """Six tables, paid by request up to a limit, and a bucket. Every topic is a time series: partition key
    topic, sort key time. The quarantine has one item per message, by robot, and the findings one per finding
    and drive.

    All other stacks use ``encryption`` for their resources.
    """

    def __init__(self, app: App, settings: Settings) -> None:
        super().__init__(app, "storage", settings)
        self.encryption = Encryption.of(self, settings)
        self.telemetry = self._table(
            "Batches",
            output="TelemetryTable",
            partition=TOPIC,
            sort=BATCH,
            sort_type=_TEXT,
            expires=True,
            stream=dynamodb.StreamViewType.NEW_IMAGE,
        )
        self.summary = self._table("Summary", partition=TOPIC, sort=SECOND, expires=True)
        self.robots = self._table("Robots", partition=ROBOT)
        # A row an hour of a stream, and the marks of what is to be archived.
        self.archive = self._table("Archive", partition=TOPIC, sort=HOUR, sort_type=_TEXT)
        self.quarantine = self._table(
            "Quarantine", partition=ROBOT, sort=ENTRY, sort_type=_TEXT, expires=True
        )
        self.findings = self._table("Findings", partition=ROBOT, sort=FINDING, sort_type=_TEXT)
        self.files = self._files()
        # Who imports recordings gives them the rest of their time in the table.
        CfnOutput(self, "RetentionDays", value=str(settings.retention_days))

    def _table(
        self,
        name: str,
        *,
        partition: str,
        sort: str | None = None,
        sort_type: dynamodb.AttributeType = dynamodb.AttributeType.NUMBER,
        expires: bool = False,
        stream: dynamodb.StreamViewType | None = None,
        output: str | None = None,
    ) -> dynamodb.Table:
        table = dynamodb.Table(
            self,
            name,
            partition_key=dynamodb.Attribute(name=partition, type=_TEXT),
            sort_key=dynamodb.Attribute(name=sort, type=sort_type) if sort else None,
            billing_mode=dynamodb.BillingMode.PAY_PER_REQUEST,
            time_to_live_attribute=EXPIRES_S if expires else None,
            stream=stream,
            removal_policy=self.removal_policy,
            deletion_protection=self.settings.protected,
            point_in_time_recovery_specification=dynamodb.PointInTimeRecoverySpecification(
                point_in_time_recovery_enabled=self.settings.protected
            ),
            # AWS applies it at its best: "DynamoDB maximum throughput for on-demand tables".
            max_write_request_units=self.settings.writes[name],
            **self.encryption.table,
        )
        CfnOutput(self, output or f"{name}Table", value=table.table_name)
        return table

    def environment(self, kind: type[E], **more: Any) -> E:
        """A function's variables by their names: of ``more``, a table, the bucket, or a setting."""
        tables = ("telemetry", "summary", "robots", "archive", "quarantine", "findings")
        own = {f"{name}_table": getattr(self, name).table_name for name in tables}
        known = {**own, "files_bucket": self.files.bucket_name, **more}
        return kind(
            **{
                one.name: known[one.name] if one.name in known else getattr(self.settings, one.name)
                for one in fields(kind)
            }
        )

    def may_keep(self, role: iam.IGrantable, *attributes: str) -> None:
        """Let a role change only these attributes of a robot's row: a name's admission and its vehicle are in
        the same row. A ``*`` stands for the rest of a name.

        Source: DynamoDB, "Using IAM policy conditions for fine-grained access control". The condition only
        protects attributes that the answer may not return.
        """
        self.may_change(self.robots, role, ROBOT, *attributes)

    @staticmethod
    def may_change(table: dynamodb.Table, role: iam.IGrantable, *attributes: str) -> None:
        """Let a role change only these attributes of a table's items; the keys are among them."""
        statement = iam.PolicyStatement(
            actions=["dynamodb:UpdateItem"],
            resources=[table.table_arn],
            conditions={
                "ForAllValues:StringLike": {"dynamodb:Attributes": sorted({*attributes})},
                "StringEqualsIfExists": {"dynamodb:ReturnValues": ["NONE", "UPDATED_NEW", "UPDATED_OLD"]},
            },
        )
        role.grant_principal.add_to_principal_policy(statement)

    def _files(self) -> s3.Bucket:
        """Files too large for a message, and what is kept of telemetry. In `prod` what a function or a person
        deletes or writes over stays as an earlier version for a month; no role of ours may delete one."""
        protected = self.settings.protected
        soon = Duration.days(1) if protected else None
        rules = [
            s3.LifecycleRule(id="abandoned", abort_incomplete_multipart_upload_after=Duration.days(7)),
            s3.LifecycleRule(
                id="results",
                prefix=RESULTS_PREFIX,
                expiration=Duration.days(1),
                noncurrent_version_expiration=soon,
            ),
            s3.LifecycleRule(
                id="plans",
                prefix=PLANS_PREFIX,
                expiration=Duration.days(7),
                noncurrent_version_expiration=soon,
            ),
        ]
        if protected:
            rules.append(
                s3.LifecycleRule(
                    id="versions",
                    noncurrent_version_expiration=Duration.days(VERSIONS_DAYS),
                    expired_object_delete_marker=True,
                )
            )
        # Read at once as ever, stored at a sixth of the price, and kept for good.
        rarest = s3.Transition(
            storage_class=s3.StorageClass.GLACIER_INSTANT_RETRIEVAL,
            transition_after=Duration.days(_RARE_AFTER_DAYS),
        )
        rules.append(s3.LifecycleRule(id="archive", prefix=ARCHIVE_PREFIX, transitions=[rarest]))
        days = self.settings.files_days
        if not 0 < days <= _RARE_AFTER_DAYS:
            rare = s3.Transition(
                storage_class=s3.StorageClass.INFREQUENT_ACCESS,
                transition_after=Duration.days(_RARE_AFTER_DAYS),
            )
            rules.append(s3.LifecycleRule(id="rare", prefix=FILES_PREFIX, transitions=[rare]))
        if days:
            rules.append(s3.LifecycleRule(id="old", prefix=FILES_PREFIX, expiration=Duration.days(days)))
        bucket = s3.Bucket(
            self,
            "Files",
            block_public_access=s3.BlockPublicAccess.BLOCK_ALL,
            object_ownership=s3.ObjectOwnership.BUCKET_OWNER_ENFORCED,
            enforce_ssl=True,
            minimum_tls_version=1.2,
            lifecycle_rules=rules,
            versioned=protected,
            # CloudFormation deletes only an empty bucket, so `iort files empty` comes first. The CDK's own
            # way deploys a function that may delete every object, for good.
            removal_policy=self.removal_policy,
            **self.encryption.bucket,
        )
        CfnOutput(self, "FilesBucket", value=bucket.bucket_name)
        return bucket
