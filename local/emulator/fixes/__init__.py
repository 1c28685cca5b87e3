"""The differences between ministack and AWS for which no small patch exists (local/patches/).

A fix is a function `close_<name>` of a module here, which closes the difference in this process; its
docstring says what AWS does, what ministack does instead, which test shows it, and why it has no patch. The
code wraps private functions of ministack, which is pinned. tests/local/emulator/test_fixes.py fails when a
new release has changed one of them, so that somebody looks whether the fix is still needed. It uses the
contract and the ledger, nothing else of this project.
"""

from __future__ import annotations

from importlib import import_module

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


def install() -> None:
    """Close every difference in this process, before the emulator starts."""
    for name in NAMES:
        close(name)


def close(name: str) -> None:
    """Close one difference. Only here is ministack imported."""
    module, function = name.split(".")
    vars(import_module(f"{__name__}.{module}"))[f"close_{function}"]()
