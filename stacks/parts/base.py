"""What every stack of the platform has: its name, its settings, and the key for what it stores."""

from __future__ import annotations

from aws_cdk import App, CliCredentialsStackSynthesizer, Stack

from stacks.parts.encryption import Encryption
from stacks.settings import Settings


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
