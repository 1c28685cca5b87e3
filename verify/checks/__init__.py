"""The questions, a file a subject; each file has a tuple CHECKS, and `ALL` is all of them in order."""

from __future__ import annotations

from verify.check import Check
from verify.checks import rules

ALL: tuple[Check, ...] = (*rules.CHECKS,)
