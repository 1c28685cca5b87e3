"""A payload that Python's JSON parser refuses.

AWS: acknowledges the message; a rule treats a payload that is not JSON as binary
  (https://docs.aws.amazon.com/iot/latest/developerguide/binary-payloads.html).
ministack: raises on deep nesting and on integers of over 4,300 digits. The session ends, and the message is
  never acknowledged.
Test: tests/local/test_gaps.py::test_a_payload_that_python_does_not_read_is_a_text_to_the_rules
Patch: local/patches/unreadable_payload.patch
"""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import Any

from ministack.services import iot


def install() -> None:
    """Close the gap in this process."""
    iot._rule_message = as_text_if_unreadable(iot._rule_message)


def is_open() -> bool:
    """Read both kinds of payload."""
    try:
        iot._rule_message(b"[" * 50_000 + b"]" * 50_000)
        iot._rule_message(b"9" * 5_000)
    except (RecursionError, ValueError):
        return True
    return False


def as_text_if_unreadable(read: Callable[[bytes], Any]) -> Callable[[bytes], Any]:
    """A reader that takes what Python cannot parse for text, like any payload that is not JSON."""

    @wraps(read)
    def message(payload: bytes) -> Any:
        try:
            return read(payload)
        # Python's limits: levels of nesting, and digits of an integer (sys.set_int_max_str_digits).
        except (RecursionError, ValueError):
            return payload.decode()

    return message
