"""The checks that every decoder stands on: each refuses with a `ContractError` that says what is allowed."""

from __future__ import annotations

import json
import math
import re
from functools import lru_cache
from operator import le
from typing import Any, Mapping, Sequence

from iort_contract.limits import (
    MAX_BATCH_SPAN_US,
    MAX_FIELD_CHARACTERS,
    MAX_FIELDS,
    MAX_SAMPLES,
    SCHEMA_VERSION,
    ContractError,
    Value,
)
from iort_contract.tables import NONFINITE

# A ROS field name, or a path of them; a number in a path is an array's index.
_FIELD_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]*(\.[A-Za-z0-9_]+)*")


def checked(pattern: re.Pattern[str], name: object, what: str, allowed: str) -> str:
    """``name`` itself if it matches the whole pattern."""
    if not isinstance(name, str) or not pattern.fullmatch(name):
        raise ContractError(f"{what} {shown(name)}: allowed is {allowed}")
    return name


BOOT = re.compile(r"[0-9a-f]{8,32}")
MAX_SEQ = 2**53
# Microseconds within +-285 years of the epoch: what a JavaScript number holds exactly.
_MAX_TIME_US = 2**53
_PLAIN = {int, float, bool, str, type(None)}
_MAX_INT, _MIN_INT, _MAX_TEXT = 2**64 - 1, -(2**63), 4096


def wire_column(name: str, column: Sequence[Any]) -> tuple[list[Value], int]:
    """The column with None for what is not finite and integers for whole floats; how many nulled."""
    kinds = set(map(type, column))
    if not kinds <= _PLAIN:
        odd = next(value for value in column if type(value) not in _PLAIN)
        raise ContractError(f"field {name}: {shown(odd)} is neither number, text, true, false nor null")
    nulled = 0
    out: list[Value] = list(column)
    # Whole columns are looked at in C where they hold one kind; a car and Lambda 2 do this for every batch.
    if kinds == {int} and min(column) >= _MIN_INT and max(column) <= _MAX_INT:
        return out, 0
    if kinds == {float} and all(map(math.isfinite, column)) and not any(map(float.is_integer, column)):
        return out, 0
    if float in kinds:
        for i, value in enumerate(out):
            if type(value) is float:
                if not math.isfinite(value):
                    out[i] = None
                    nulled += 1
                elif value.is_integer() and -(2.0**53) < value < 2.0**53:
                    out[i] = int(value)
    if int in kinds and any(type(v) is int and not _MIN_INT <= v <= _MAX_INT for v in out):
        raise ContractError(f"field {name}: an integer does not fit in 64 bits")
    if str in kinds and any(type(v) is str and not _is_text(v) for v in out):
        raise ContractError(f"field {name}: a text is over {_MAX_TEXT} characters or not Unicode")
    return out, nulled


# Made once: json.dumps makes one a call, which costs as much as the message.
COMPACT = json.JSONEncoder(separators=(",", ":"), allow_nan=False)


def wire_sample(sample: Mapping[str, Any]) -> tuple[dict[str, Value], int]:
    """As `wire_column`, of one value a field; all at once, for this is the live lane's way."""
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
    """Return ``name`` if it may name a field."""
    if isinstance(name, str) and len(name) > MAX_FIELD_CHARACTERS:
        raise ContractError(f"field name {shown(name)}: over {MAX_FIELD_CHARACTERS} characters")
    return checked(_FIELD_NAME, name, "field name", "a ROS field name or a dotted path of them")


def _is_text(value: str) -> bool:
    try:
        # Half of a surrogate pair is the one character that UTF-8 does not have.
        return len(value) <= _MAX_TEXT and (value.isascii() or bool(value.encode()))
    except UnicodeEncodeError:
        return False


def check_version(envelope: Mapping[str, Any], known: int = SCHEMA_VERSION) -> None:
    """Refuse every schema version but this side's."""
    version = integer(envelope, "v")
    if version != known:
        raise ContractError(f"schema version {version}: this side knows {known}")


def check_header(boot: Any, seq: Any, nonfinite: Any) -> str:
    """The run's name, if it and the two counts are what a message may say."""
    if not isinstance(boot, str) or not BOOT.fullmatch(boot):
        raise ContractError(f"boot {shown(boot)}: allowed is 8 to 32 of 0-9 a-f")
    if type(seq) is not int or not 0 <= seq <= MAX_SEQ:
        raise ContractError(f"seq {shown(seq)}: allowed is an integer from 0")
    if type(nonfinite) is not int or not 0 <= nonfinite <= MAX_SAMPLES * MAX_FIELDS:
        raise ContractError(f"{NONFINITE} {shown(nonfinite)}: allowed is an integer from 0")
    return boot


def check_time(t_us: Any, what: str) -> int:
    """The time itself, whole microseconds since the epoch."""
    if type(t_us) is not int or not -_MAX_TIME_US < t_us < _MAX_TIME_US:
        raise ContractError(f"{what} {shown(t_us)}: allowed is whole microseconds since the epoch")
    return t_us


def offset_entry(offset_us: Any) -> dict[str, int]:
    """The offset as an envelope's entry; nothing where it is not known."""
    return {} if offset_us is None else {"offset_us": check_time(offset_us, "offset_us")}


def check_times(times_us: Sequence[int]) -> None:
    """Refuse times that are not in order, or that span more than a batch may."""
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
    """The integer under a key, whatever numeric type the envelope came with."""
    value: Any = envelope.get(key)
    try:
        # Numbers of a stored item arrive as Decimal, which compares equal to the integer it holds.
        # The bounds come first: the integer of Decimal("1E+999999") is a megabyte of digits.
        if not isinstance(value, bool) and _MIN_INT <= value <= _MAX_INT:
            integer = int(value)
            if integer == value:
                return integer
    except (TypeError, ValueError, ArithmeticError) as error:
        raise ContractError(f"{key} {shown(value)}: expected an integer") from error
    raise ContractError(f"{key} {shown(value)}: expected an integer")


def text(envelope: Mapping[str, Any], key: str) -> str:
    """The text under a key."""
    value = envelope.get(key)
    if not isinstance(value, str):
        raise ContractError(f"{key} {shown(value)}: expected a text")
    return value


def json_object(text: Any, what: str) -> dict[str, Any]:
    """The object that the text holds."""
    try:
        value = json.loads(text, parse_constant=_refuse_constant)
    except RecursionError as error:
        raise ContractError(f"{what} is nested too deeply") from error
    except (TypeError, ValueError) as error:
        raise ContractError(f"{what} is not JSON: {error}") from error
    if not isinstance(value, dict):
        raise ContractError(f"{what} is not a JSON object")
    return value


def _refuse_constant(name: str) -> None:
    raise ContractError(f"{name} is not JSON")


def shown(value: Any) -> str:
    """A value as an error shows it: short, whatever it is."""
    try:
        text = repr(value)
    except (ValueError, RecursionError):  # an integer of thousands of digits, a list within lists
        text = f"<{type(value).__name__}>"
    return text if len(text) <= 60 else text[:57] + "..."
