"""What a topic rule makes of a message, by the emulator's SQL.

tests/unit/local/test_rule_sql.py holds it to the examples of AWS' documentation.
"""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any
from unittest import mock

from ministack.services import iot


def evaluate(sql: str, topic: str, payload: bytes, now_ms: int) -> Any:
    """Return the input of the rule's actions, as the patched broker does; None if the rule does not act.

    ``topic`` has no Basic Ingest prefix, and is not compared with the statement's filter.
    """
    message = iot._rule_message(payload)
    where = iot._rule_where_clause(sql)
    with mock.patch.object(iot, "time", SimpleNamespace(time=lambda: now_ms / 1000)):
        if where and not iot._eval_where(where, topic, payload, message):
            return None
        return iot._rule_event(sql, topic, payload, message=message)
