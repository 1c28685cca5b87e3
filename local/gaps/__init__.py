"""The differences between ministack and AWS for which no small patch exists (local/patches/), one file each.

A gap's docstring says what AWS does, what ministack does instead, which test shows it, and why it has no
patch. `install` closes the gap in this process. `is_open` tells whether the imported ministack still has it,
so that tests/local/gaps/test_gaps.py fails when a new release needs a gap no more. The code wraps private
functions of ministack, which is pinned. It uses the contract, and nothing else of this project.
"""

from __future__ import annotations

from importlib import import_module
from typing import Protocol, cast

# In the order of their installation: a later wrapper is around an earlier one.
NAMES = (
    "broker.client_certificate",
    "broker.delivery_time",
    "broker.https_port",
    "broker.rule_time",
    "broker.server_certificate",
    "functions.async_invocations",
    "functions.stream_retries",
    "functions.log_end",
    "functions.log_retention",
    "storage.query_time",
    "storage.number_checks",
    "storage.object_expiry",
    "storage.request_time",
    "storage.own_paths",
    "metrics.embedded_metrics",
    "metrics.lambda_metrics",
    "metrics.iot_metrics",
    "metrics.queue_metrics",
    "metrics.metric_search",
    "metrics.alarm_state",
    "metrics.alarm_timer",
)


class Gap(Protocol):
    """The module of one gap."""

    __doc__: str | None

    def install(self) -> None:
        """Close the gap in this process, before the emulator starts."""

    def is_open(self) -> bool:
        """Whether the imported ministack has the gap; ask before `install`."""


def load(name: str) -> Gap:
    """The gap of this name. Only here is ministack imported."""
    return cast(Gap, import_module(f"{__name__}.{name}"))


def install() -> None:
    """Close every gap in this process, before the emulator starts."""
    for name in NAMES:
        load(name).install()
