"""A queue of ours: encrypted, TLS only, with the longest retention."""

from __future__ import annotations

from aws_cdk import CfnOutput, Duration
from aws_cdk import aws_sqs as sqs

from stacks.parts.base import PlatformStack

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
        removal_policy=stack.settings.removal_policy,
        # AWS advises six times the function's timeout.
        visibility_timeout=Duration.seconds(6 * reader_timeout_s) if reader_timeout_s else None,
        dead_letter_queue=sqs.DeadLetterQueue(max_receive_count=_ATTEMPTS, queue=failures)
        if failures
        else None,
        **stack.encryption.queue,
    )
    CfnOutput(stack, f"{name}Queue", value=made.queue_url)
    return made
