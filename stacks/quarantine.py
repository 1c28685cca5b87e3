"""The quarantine: one queue that takes every failure, and a table that keeps it.

A rule's error action, a stream batch that Summarize gave up, a failed asynchronous invocation and a record
that Summarize refused all go to ``rejected``; the function moves them into the quarantine table. After five
failed attempts a message goes to ``last``, the dead-letter queue, which only the operator reads. A failure
there cannot come back to the beginning.
"""

from __future__ import annotations

from aws_cdk import App
from aws_cdk import aws_lambda as lambda_

from iort_contract.catalog.environments import QuarantineEnvironment
from stacks.parts import PlatformStack, function, queue
from stacks.settings import LEAST_OF_A_QUEUE, Settings
from stacks.storage import Storage

_TIMEOUT_S = 10


class Quarantine(PlatformStack):
    """The queues ``rejected`` and ``last``, and the ``function`` between queue and table."""

    def __init__(self, app: App, settings: Settings, storage: Storage) -> None:
        super().__init__(app, "quarantine", settings, storage.encryption)
        self.last = queue(self, "Last")
        self.rejected = queue(self, "Rejected", reader_timeout_s=_TIMEOUT_S, failures=self.last)
        self.function = function(
            self,
            "Quarantine",
            storage.environment(QuarantineEnvironment),
            timeout_s=_TIMEOUT_S,
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
            # A flood of refusals waits in the queue, which is cheaper than the table.
            max_concurrency=LEAST_OF_A_QUEUE,
            report_batch_item_failures=True,
        )
