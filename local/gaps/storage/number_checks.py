"""The time that a number takes.

AWS: does not apply; what it takes AWS to read a number does not show
  (https://docs.aws.amazon.com/amazondynamodb/latest/developerguide/HowItWorks.NamingRulesDataTypes.html).
ministack: takes every number of an item apart several times. A batch has hundreds of them. Here plain digits
  pass at once, and the others are read as before.
Test: tests/local/gaps/test_table_gap.py::test_numbers_are_read_as_unpatched
Patch: none; it is about speed only, so that upstream should measure it with its own load
"""

from __future__ import annotations

import re
from collections.abc import Callable
from functools import lru_cache, wraps
from typing import Any
from unittest.mock import Mock, patch

from ministack.services import dynamodb

_REMEMBERED_NUMBERS = 16_384
# A number in DynamoDB's own form, short enough for every limit: nothing has to be changed or refused.
_PLAIN = re.compile(r"-?(?:0|[1-9][0-9]*)(?:\.[0-9]*[1-9])?")
_PLAIN_DIGITS = 30


def install() -> None:
    """Close the gap in this process."""
    dynamodb._number_size_bytes = lru_cache(_REMEMBERED_NUMBERS)(dynamodb._number_size_bytes)
    dynamodb._ddb_canonicalize_number = plainly(dynamodb._ddb_canonicalize_number, lambda text: text)
    dynamodb._number_error = plainly(dynamodb._number_error, lambda _: None)


def is_open() -> bool:
    """Read a plain number, and look whether it is taken apart."""
    decimal = Mock(side_effect=dynamodb.Decimal)
    with patch.object(dynamodb, "Decimal", decimal):
        dynamodb._ddb_canonicalize_number("1.5")
    return bool(decimal.called)


def plainly(look: Callable[[Any], Any], answer: Callable[[str], Any]) -> Callable[[Any], Any]:
    """``look``, with the answer for plain digits given at once."""

    @wraps(look)
    def number(text: Any) -> Any:
        plain = isinstance(text, str) and len(text) <= _PLAIN_DIGITS and _PLAIN.fullmatch(text)
        return answer(text) if plain and text != "-0" else look(text)

    return number
