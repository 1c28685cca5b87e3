"""The quarantine: one queue that takes every failure, and a table that keeps it.

A rule's error action, a stream batch that Lambda 2 gave up, a failed asynchronous invocation and a record
that Lambda 2 refused all go to ``rejected``; the function moves them into the quarantine table. After five
failed attempts a message goes to ``last``, the dead-letter queue, which only the operator reads. A failure
there cannot come back to the beginning.
"""

from __future__ import annotations

from typing import Any

from aws_cdk import Duration, Stack
from aws_cdk import aws_lambda as lambda_
from aws_cdk import aws_sqs as sqs
from constructs import Construct

from stacks.parts.function import function
from stacks.parts.queue import queue
from stacks.settings import Settings
from stacks.storage import Storage

_TIMEOUT_S = 10
_ATTEMPTS = 5
# Concurrent batches of ten messages: a flood of refusals waits in the queue, which is cheaper than the table.
_CONCURRENCY = 2


class Quarantine(Stack):
    """The queues ``rejected`` and ``last``, and the ``function`` between queue and table."""

    def __init__(
        self, scope: Construct, construct_id: str, *, settings: Settings, storage: Storage, **kwargs: Any
    ) -> None:
        super().__init__(scope, construct_id, **kwargs)
        self.last = queue(self, "Last", settings=settings, encryption=storage.encryption)
        self.rejected = queue(
            self,
            "Rejected",
            settings=settings,
            encryption=storage.encryption,
            # AWS advises six times the function's time.
            visibility_timeout=Duration.seconds(6 * _TIMEOUT_S),
            dead_letter_queue=sqs.DeadLetterQueue(max_receive_count=_ATTEMPTS, queue=self.last),
        )
        self.function = function(
            self,
            "Quarantine",
            settings=settings,
            encryption=storage.encryption,
            memory_mb=256,
            timeout_s=_TIMEOUT_S,
            environment={
                "QUARANTINE_TABLE": storage.quarantine.table_name,
                "RETENTION_S": str(settings.retention_days * 86_400),
            },
        )
        storage.quarantine.grant(self.function, "dynamodb:UpdateItem")
        # A failed batch is reported only by its place in the stream, so its records are read again.
        storage.telemetry.grant_stream(self.function, "dynamodb:GetRecords", "dynamodb:GetShardIterator")
        self.rejected.grant_consume_messages(self.function)
        lambda_.EventSourceMapping(
            self,
            "Rejections",
            target=self.function,
            event_source_arn=self.rejected.queue_arn,
            batch_size=10,
            max_concurrency=_CONCURRENCY,
            report_batch_item_failures=True,
        )
