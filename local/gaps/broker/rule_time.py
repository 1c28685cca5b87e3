"""The time of a rule.

AWS: does not apply; what a rule's SQL costs AWS does not show
  (https://docs.aws.amazon.com/iot/latest/developerguide/iot-sql-reference.html).
ministack: takes the SQL of every rule apart for every message. Here it is taken apart once.
Test: tests/local/gaps/test_time_gaps.py::test_a_rule_is_taken_apart_once
Patch: none; it is about speed only, so that upstream should measure it with its own load
"""

from __future__ import annotations

from functools import lru_cache

from ministack.services import iot

_REMEMBERED = 1_024
OF_THE_SQL_ALONE = (
    "_rule_topic_filter",
    "_rule_select_clause",
    "_rule_where_clause",
    "_split_select_items",
    "_split_select_alias",
    "_sql_string_value",
)


def install() -> None:
    """Close the gap in this process."""
    for name in OF_THE_SQL_ALONE:
        setattr(iot, name, lru_cache(_REMEMBERED)(getattr(iot, name)))


def is_open() -> bool:
    """Look whether a rule's topic is remembered."""
    return not hasattr(iot._rule_topic_filter, "cache_info")
