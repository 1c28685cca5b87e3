"""Times and durations as people write them, in microseconds."""

from __future__ import annotations

import re
from datetime import datetime, timedelta, timezone
from operator import index
from typing import TYPE_CHECKING, Any, TypeAlias

from iort_station.errors import UsageError

if TYPE_CHECKING:
    from iort_contract.messages.insights import Extent
    from iort_contract.messages.page import Archived

Time: TypeAlias = int | str | datetime

_UNITS_US = {
    "us": 1,
    "ms": 1_000,
    "s": 1_000_000,
    "m": 60_000_000,
    "min": 60_000_000,
    "h": 3_600_000_000,
    "d": 86_400_000_000,
    "w": 604_800_000_000,
}
# A century.
_MOST_US = 36_525 * _UNITS_US["d"]
_DURATION = re.compile(r"(\d+(?:\.\d+)?)\s*(us|ms|s|min|m|h|d|w)")
_CLOCK = re.compile(r"\d{1,2}:\d{2}(:\d{2}(\.\d+)?)?([zZ]|[+-]\d\d(:?\d\d)?)?")
_EPOCH = datetime(1970, 1, 1, tzinfo=timezone.utc)


def duration_us(text: str) -> int:
    """Parse a duration such as ``100ms``, ``1s``, ``10m``, ``1.5h`` or ``7d``; raises `UsageError`."""
    match = _DURATION.fullmatch(text.strip())
    length_us = float(match[1]) * _UNITS_US[match[2]] if match else 0.0
    if not 0.5 < length_us < _MOST_US:
        raise UsageError(f"duration must be a number with us, ms, s, m, h, d or w, such as 10m, got {text!r}")
    return round(length_us)


def time_us(value: Time, now_us: int) -> int:
    """Parse a time: microseconds since the epoch, a datetime, or a text such as ``now``, ``-10m``, ``20:04``
    or ``2026-05-04T10:00:00+02:00``. Without a zone it is local to this machine; without a date it is the
    newest one that has been.

    Raises `UsageError`.
    """
    if not isinstance(value, str):
        return _since_epoch(value)
    text = value.strip()
    if text == "now":
        return now_us
    if text.startswith("-"):
        return now_us - duration_us(text[1:])
    try:
        # Python 3.10 reads neither Z nor fractions other than 3 or 6 digits.
        normal = re.sub(r"\.(\d{1,6})\d*", lambda m: "." + m[1].ljust(6, "0"), text)
        normal = re.sub(r"[zZ]$", "+00:00", normal)
        if not _CLOCK.fullmatch(text):
            return time_us(datetime.fromisoformat(normal), now_us)
        # The zone's own day may be another one than this machine's.
        clock = datetime.fromisoformat(f"2000-01-01T{'0' * (normal[1] == ':')}{normal}").timetz()
        today = datetime.fromtimestamp(now_us / 1e6, clock.tzinfo).date()
        at_us = time_us(datetime.combine(today, clock), now_us)
        return (
            at_us if at_us <= now_us else time_us(datetime.combine(today - timedelta(days=1), clock), now_us)
        )
    except (ValueError, OverflowError) as error:
        raise UsageError(
            "time must be now, -10m for ten minutes ago, 20:04, or ISO 8601 such as 2026-05-04T10:00:00Z, "
            f"got {value!r}"
        ) from error


def _since_epoch(value: int | datetime) -> int:
    try:
        if isinstance(value, datetime):
            return (value.astimezone(timezone.utc) - _EPOCH) // timedelta(microseconds=1)
        # numpy's integers too, which are a query's times.
        t_us = index(value)
        _EPOCH + timedelta(microseconds=t_us)
    except (TypeError, ValueError, OverflowError) as error:
        raise UsageError(
            "time must be microseconds since the epoch as an integer, a datetime or a text, in the years 1 "
            f"to 9999, got {value!r}"
        ) from error
    return t_us


def is_clock(text: str) -> bool:
    """Whether a time's text has no date."""
    return _CLOCK.fullmatch(text.strip()) is not None


def has_zone(text: str) -> bool:
    """Whether a time's text has a time zone, or needs none."""
    text = text.strip()
    clock = text if is_clock(text) else text.partition("T")[2] or text.partition(" ")[2]
    return text == "now" or text.startswith("-") or re.search(r"([zZ]|[+-]\d\d(:?\d\d)?)$", clock) is not None


def iso(t_us: int) -> str:
    """The time as ISO 8601 in UTC, to the microsecond."""
    return _iso(t_us, "microseconds")


def iso_s(t_us: int) -> str:
    """The time as ISO 8601 in UTC, cut to the second."""
    return _iso(t_us, "seconds")


def stamped(name: str, t_us: int | None) -> dict[str, Any]:
    """A time for JSON: ``name`` as ISO 8601, and ``name_us`` since the epoch; both null for None."""
    return {name: None if t_us is None else iso(t_us), f"{name}_us": t_us}


def between(extent: Extent) -> dict[str, Any]:
    """An extent for JSON."""
    return {**stamped("from", extent["from_us"]), **stamped("to", extent["to_us"])}


def between_hours(archived: Archived) -> dict[str, Any]:
    """What came from the archive, for JSON."""
    return {**between(archived), "hours": archived["hours"]}


def _iso(t_us: int, to: str) -> str:
    at = _EPOCH + timedelta(microseconds=t_us)
    return at.isoformat(timespec=to).replace("+00:00", "Z")
