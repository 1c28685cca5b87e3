"""The questions, one file per subject; each file has a tuple CHECKS, and `ALL` joins them in order."""

from __future__ import annotations

from verify.check import Check
from verify.checks import (
    alarms,
    broker,
    dynamodb,
    files,
    functions,
    live,
    logs,
    payloads,
    provisioning,
    quarantine,
    removal,
    renewal,
    rule_errors,
    rules,
    stream,
)

ALL: tuple[Check, ...] = (
    *rules.CHECKS,
    *payloads.CHECKS,
    *rule_errors.CHECKS,
    *broker.CHECKS,
    *provisioning.CHECKS,
    *renewal.CHECKS,
    *removal.CHECKS,
    *stream.CHECKS,
    *quarantine.CHECKS,
    *dynamodb.CHECKS,
    *functions.CHECKS,
    *logs.CHECKS,
    *files.CHECKS,
    *live.CHECKS,
    *alarms.CHECKS,
)
