"""The archive: finished hours of telemetry go from the table to Parquet in the files' bucket."""

from __future__ import annotations

from aws_cdk import App
from aws_cdk import aws_lambda as lambda_

from iort_contract.archive import ARCHIVE_PREFIX, DUE, SWEEP, TASK
from iort_contract.catalog.environments import ArchiveEnvironment
from iort_contract.tables import BATCH, EXPIRES_S, PUT_OFF_TO_S, TOPIC
from stacks import parts
from stacks.parts import PlatformStack, allow, function, queue, schedules
from stacks.quarantine import Quarantine
from stacks.settings import Settings
from stacks.storage import Storage

# docs/reference/archive.md tells the times that these are for.
_MEMORY_MB, _TIMEOUT_S, _SCRATCH_MB = 1769, 600, 4096


class Archive(PlatformStack):
    """A function, its schedules, and the queue of its tasks: an hour or a day of a stream each."""

    def __init__(self, app: App, settings: Settings, *, storage: Storage, quarantine: Quarantine) -> None:
        super().__init__(app, "archive", settings, storage.encryption)
        tasks = queue(self, "ArchiveTasks", reader_timeout_s=_TIMEOUT_S, failures=quarantine.rejected)
        archive = function(
            self,
            "Archive",
            storage.environment(ArchiveEnvironment, archive_queue=tasks.queue_url),
            memory_mb=_MEMORY_MB,
            timeout_s=_TIMEOUT_S,
            scratch_mb=_SCRATCH_MB,
            layers=parts.arrays(self),
            arrays=True,
        )
        storage.telemetry.grant(archive, "dynamodb:Query")
        storage.may_change(storage.telemetry, archive, TOPIC, BATCH, EXPIRES_S, PUT_OFF_TO_S)
        storage.archive.grant(
            archive,
            *(f"dynamodb:{verb}Item" for verb in ("Get", "Put", "Update", "Delete")),
            "dynamodb:Query",
        )
        storage.robots.grant(archive, "dynamodb:Scan")
        objects = storage.files.arn_for_objects(f"{ARCHIVE_PREFIX}*")
        allow(archive, ["s3:DeleteObject", "s3:GetObject", "s3:PutObject"], objects)
        # Without it a missing object is a refusal.
        allow(archive, ["s3:ListBucket"], storage.files.bucket_arn)
        tasks.grant_send_messages(archive)
        tasks.grant_consume_messages(archive)
        lambda_.EventSourceMapping(
            self,
            "Tasks",
            target=archive,
            event_source_arn=tasks.queue_arn,
            batch_size=1,
            max_concurrency=settings.at_once.tasks,
        )
        # Every hour at a quarter past, and at night.
        when = {
            "Hourly": ("cron(15 * * * ? *)", {TASK: DUE}),
            "Daily": ("cron(40 2 * * ? *)", {TASK: SWEEP}),
        }
        schedules(self, archive, when, on=settings.archive)
