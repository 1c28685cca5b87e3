"""The differences between ministack and AWS for which no small patch exists (local/patches/).

A fix is two functions of a module here. `close_<name>` closes the difference in this process; its docstring
says what AWS does, what ministack does instead, which test shows it, and why it has no patch.
`<name>_is_open` tells whether the imported ministack still has it, so that
tests/local/emulator/test_fixes.py fails when a new release needs a fix no more. The code wraps private
functions of ministack, which is pinned. It uses the contract and the ledger, nothing else of this project.
"""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from typing import NamedTuple

# In the order of their installation: a later wrapper is around an earlier one.
NAMES = (
    "broker.client_certificate",
    "broker.delivery_time",
    "broker.https_port",
    "broker.rule_time",
    "broker.server_certificate",
    "invocations.async_invocations",
    "stream_retries.stream_retries",
    "invocations.log_end",
    "invocations.log_retention",
    "tables.query_time",
    "tables.number_checks",
    "storage.object_expiry",
    "storage.request_time",
    "storage.own_paths",
    "metrics.embedded_metrics",
    "metrics.lambda_metrics",
    "metrics.iot_metrics",
    "metrics.queue_metrics",
    "metrics.metric_search",
    "alarms.alarm_state",
    "alarms.alarm_timer",
)


class Fix(NamedTuple):
    """One difference: closes it before the emulator starts; asked before, tells whether ministack has it."""

    close: Callable[[], None]
    is_open: Callable[[], bool]


def load(name: str) -> Fix:
    """The fix of this name. Only here is ministack imported."""
    module, function = name.split(".")
    functions = vars(import_module(f"{__name__}.{module}"))
    return Fix(functions[f"close_{function}"], functions[f"{function}_is_open"])


def install() -> None:
    """Close every difference in this process, before the emulator starts."""
    for name in NAMES:
        load(name).close()
