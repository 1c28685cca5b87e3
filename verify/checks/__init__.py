"""The questions, a file a subject; each file has a tuple CHECKS, and `ALL` is all of them in order."""

from __future__ import annotations

from verify.check import Check
from verify.checks import broker, payloads, provisioning, removal, renewal, rule_errors, rules

ALL: tuple[Check, ...] = (
    *rules.CHECKS,
    *payloads.CHECKS,
    *rule_errors.CHECKS,
    *broker.CHECKS,
    *provisioning.CHECKS,
    *renewal.CHECKS,
    *removal.CHECKS,
)
