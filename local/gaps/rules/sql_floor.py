"""The SQL function floor().

AWS: rounds a number down to an integer
  (https://docs.aws.amazon.com/iot/latest/developerguide/iot-sql-functions.html).
ministack: does not know the function; its result is undefined.
Test: tests/local/test_gaps.py::test_floor
Patch: local/patches/sql_floor.patch
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import wraps
from typing import Any

from ministack.services import iot


def install() -> None:
    """Close the gap in this process."""
    iot._eval_select_function = with_floor(iot._eval_select_function)
    iot._IMPLEMENTED_SQL_FUNCS |= {"floor"}


def is_open() -> bool:
    """Evaluate a statement with floor()."""
    event = iot._rule_event("SELECT floor(1.5) AS n FROM 'a'", "a", b"{}", message={})
    return bool(event != {"n": 1})


def with_floor(evaluate: Callable[..., Any]) -> Callable[..., Any]:
    """Ministack's evaluation of a function, with floor()."""

    @wraps(evaluate)
    def evaluate_function(name: str, args: list[str], *context: Any) -> Any:
        if name != "floor" or len(args) != 1:
            return evaluate(name, args, *context)
        value = iot._sql_as_number(iot._eval_select_expr(args[0], *context))
        return iot._MISSING if value is None else math.floor(value)

    return evaluate_function
