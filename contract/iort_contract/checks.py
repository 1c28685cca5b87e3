"""The checks behind every decoder; each one raises a `ContractError` with the allowed values."""

from __future__ import annotations

import json
import math
import re
from functools import lru_cache
from itertools import accumulate
from operator import le
from typing import Any, Mapping, Sequence

from iort_contract.limits import (
    MAX_BATCH_SPAN_US,
    MAX_FIELD_CHARACTERS,
    MAX_FIELDS,
    MAX_NESTED,
    MAX_SAMPLES,
    SCHEMA_VERSION,
    ContractError,
    Value,
)
from iort_contract.tables import NONFINITE

# A ROS field name, or a path of them; a number in a path is an array's index.
FIELD_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]*(\.[A-Za-z0-9_]+)*")


def checked(pattern: re.Pattern[str], name: object, what: str, allowed: str) -> str:
    """Return ``name`` if it matches the whole pattern."""
    if not isinstance(name, str) or not pattern.fullmatch(name):
        raise ContractError(f"{what} must be {allowed}, got {shown(name)}")
    return name


BOOT = re.compile(r"[0-9a-f]{8,32}")
MAX_SEQ = 2**53
# Microseconds within +-285 years of the epoch: a JavaScript number holds them exactly.
_MAX_TIME_US = 2**53
_PLAIN = {int, float, bool, str, type(None)}
_MAX_INT, _MIN_INT, _MAX_TEXT = 2**64 - 1, -(2**63), 4096


def wire_column(name: str, column: Sequence[Any]) -> tuple[list[Value], int]:
    """The column for the wire, and the number of replaced values. Numbers that are not finite become None,
    whole floats become integers."""
    kinds = set(map(type, column))
    if not kinds <= _PLAIN:
        odd = next(value for value in column if type(value) not in _PLAIN)
        raise ContractError(f"field {name} must hold numbers, texts, true, false or null, got {shown(odd)}")
    nulled = 0
    out: list[Value] = list(column)
    # Columns of one kind are checked as a whole, in C; a car and Lambda 2 do this for every batch.
    if kinds == {int} and min(column) >= _MIN_INT and max(column) <= _MAX_INT:
        return out, 0
    if kinds == {float} and all(map(math.isfinite, column)):
        whole = map(float.is_integer, column)
        return [int(v) if w and -(2.0**53) < v < 2.0**53 else v for v, w in zip(column, whole)], 0
    if float in kinds:
        for i, value in enumerate(out):
            if type(value) is float:
                if not math.isfinite(value):
                    out[i] = None
                    nulled += 1
                elif value.is_integer() and -(2.0**53) < value < 2.0**53:
                    out[i] = int(value)
    if int in kinds and any(type(v) is int and not _MIN_INT <= v <= _MAX_INT for v in out):
        raise ContractError(f"field {name}: integers must fit in 64 bits")
    if str in kinds and any(type(v) is str and not _is_text(v) for v in out):
        raise ContractError(f"field {name}: texts must be Unicode of at most {_MAX_TEXT} characters")
    return out, nulled


# Created once: json.dumps creates one per call, which costs as much as the message.
COMPACT = json.JSONEncoder(separators=(",", ":"), allow_nan=False)


def wire_sample(sample: Mapping[str, Any]) -> tuple[dict[str, Value], int]:
    """Like `wire_column`, for one value per field; all fields in one pass, since the live lane is
    time-critical."""
    for name in sample:
        check_field(name)
    try:
        values, nulled = wire_column("", list(sample.values()))
    except ContractError:
        for name, value in sample.items():
            wire_column(name, (value,))
        raise
    return dict(zip(sample, values)), nulled


@lru_cache(maxsize=4096)
def check_field(name: str) -> str:
    """Return ``name`` if it is a valid field name."""
    if isinstance(name, str) and len(name) > MAX_FIELD_CHARACTERS:
        raise ContractError(
            f"field name must be at most {MAX_FIELD_CHARACTERS} characters, got {shown(name)}"
        )
    return checked(FIELD_NAME, name, "field name", "a ROS field name or a dotted path of them")


def _is_text(value: str) -> bool:
    try:
        # UTF-8 has no lone surrogates.
        return len(value) <= _MAX_TEXT and (value.isascii() or bool(value.encode()))
    except UnicodeEncodeError:
        return False


def check_id(value: object, what: str) -> str:
    """Return the value if it is the name of a run, a session or a request."""
    return checked(BOOT, value, what, "8 to 32 of 0-9 a-f")


def check_version(envelope: Mapping[str, Any], known: int = SCHEMA_VERSION) -> None:
    """Refuse every schema version but this side's."""
    version = integer(envelope, "v")
    if version != known:
        raise ContractError(f"schema version must be {known}, got {version}")


def check_header(boot: Any, seq: Any, nonfinite: Any) -> str:
    """Return the run's name, if it and both counts are valid."""
    whole_number("seq", seq, 0, MAX_SEQ)
    check_nonfinite(nonfinite)
    return check_id(boot, "boot")


def check_nonfinite(nonfinite: Any) -> int:
    """Return the count of values that are not finite, if it is valid."""
    return whole_number(NONFINITE, nonfinite, 0, MAX_SAMPLES * MAX_FIELDS)


def check_time(t_us: Any, what: str) -> int:
    """Return the time, if it is whole microseconds since the epoch."""
    if type(t_us) is not int or not -_MAX_TIME_US < t_us < _MAX_TIME_US:
        raise ContractError(f"{what} must be whole microseconds since the epoch, got {shown(t_us)}")
    return t_us


def whole_number(name: str, value: Any, low: int, high: int) -> int:
    """Return the value, if it is an integer from ``low`` to ``high``."""
    if type(value) is not int or not low <= value <= high:
        raise ContractError(f"{name} must be an integer from {low} to {high}, got {shown(value)}")
    return value


def offset_entry(offset_us: Any) -> dict[str, int]:
    """The clock offset as an envelope's entry; empty if unknown."""
    return {} if offset_us is None else {"offset_us": check_time(offset_us, "offset_us")}


def check_times(times_us: Sequence[int]) -> None:
    """Refuse times out of order, or over a longer span than a batch may have."""
    if set(map(type, times_us)) != {int}:
        for t_us in times_us:
            check_time(t_us, "sample time")
    if not all(map(le, times_us, times_us[1:])):
        raise ContractError("sample times must be in order within a batch")
    # All others lie between them.
    check_time(times_us[0], "sample time")
    check_time(times_us[-1], "sample time")
    if times_us[-1] - times_us[0] >= MAX_BATCH_SPAN_US:
        raise ContractError(f"a batch must span less than {MAX_BATCH_SPAN_US} microseconds")


def integer(envelope: Mapping[str, Any], key: str) -> int:
    """The integer under a key, from any numeric type."""
    value: Any = envelope.get(key)
    try:
        # A stored item has Decimals, which compare equal to integers. Check the bounds first: the integer of
        # Decimal("1E+999999") is a megabyte of digits.
        if not isinstance(value, bool) and _MIN_INT <= value <= _MAX_INT:
            integer = int(value)
            if integer == value:
                return integer
    except (TypeError, ValueError, ArithmeticError) as error:
        raise ContractError(f"{key} must be an integer, got {shown(value)}") from error
    raise ContractError(f"{key} must be an integer, got {shown(value)}")


def text(envelope: Mapping[str, Any], key: str) -> str:
    """The text under a key."""
    value = envelope.get(key)
    if not isinstance(value, str):
        raise ContractError(f"{key} must be a text, got {shown(value)}")
    return value


def json_text(text: Any, what: str) -> str:
    """JSON as text, nested at most `MAX_NESTED` deep; what else is wrong with it, its parser says.

    The parser must not find that by itself: Python before 3.10 ends its process if it collects garbage with a
    finalizer where the stack is just full, and a stranger's JSON can fill the stack.
    """
    if isinstance(text, (bytes, bytearray)):
        try:
            text = text.decode(json.detect_encoding(text), "surrogatepass")
        except ValueError as error:
            raise ContractError(f"{what} is not JSON: {error}") from error
    if not isinstance(text, str):
        raise ContractError(f"{what} is not JSON: it must be a text, got {shown(text)}")
    if text.count("[") + text.count("{") > MAX_NESTED:
        brackets = _NO_BRACKETS.sub("", text)
        if max(accumulate(map(_STEPS.__getitem__, brackets)), default=0) > MAX_NESTED:
            raise ContractError(f"{what} is nested too deeply: at most {MAX_NESTED} levels are allowed")
    return text


# A text, also one without an end, or what is neither text nor bracket.
_NO_BRACKETS = re.compile(r'"[^"\\]*(?:\\.?[^"\\]*)*(?:"|\Z)|[^"\[\]{}]+', re.DOTALL)
_STEPS = {"[": 1, "{": 1, "]": -1, "}": -1}


def json_object(text: Any, what: str) -> dict[str, Any]:
    """Parse a JSON object from text."""
    text = json_text(text, what)
    try:
        value = _DECODER.decode(text)
    except ValueError as error:
        raise ContractError(f"{what} is not JSON: {error}") from error
    if not isinstance(value, dict):
        raise ContractError(f"{what} is not a JSON object")
    return value


def _refuse_constant(name: str) -> None:
    raise ContractError(f"{name} is not JSON")


# Created once, like `COMPACT`.
_DECODER = json.JSONDecoder(parse_constant=_refuse_constant)


def shown(value: Any) -> str:
    """A value in an error text: short, for any value."""
    try:
        text = repr(value)
    except (ValueError, RecursionError):  # an integer of thousands of digits, a list within lists
        text = f"<{type(value).__name__}>"
    return text if len(text) <= 60 else text[:57] + "..."
