"""A queue of ours: encrypted, TLS only, with the longest retention."""

from __future__ import annotations

from typing import Any

from aws_cdk import CfnOutput, Duration, Stack
from aws_cdk import aws_sqs as sqs

from stacks.parts.encryption import Encryption
from stacks.settings import Settings


def queue(
    stack: Stack, name: str, *, settings: Settings, encryption: Encryption, **properties: Any
) -> sqs.Queue:
    """The stack outputs its address as ``<name>Queue``."""
    made = sqs.Queue(
        stack,
        name,
        enforce_ssl=True,
        # The maximum.
        retention_period=Duration.days(14),
        removal_policy=settings.removal_policy,
        **properties,
        **encryption.queue,
    )
    CfnOutput(stack, f"{name}Queue", value=made.queue_url)
    return made
