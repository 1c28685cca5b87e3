"""The parameters of a request to the page's server: texts and numbers."""

from __future__ import annotations

from collections.abc import Mapping

from iort_station.errors import StationError


def text(asked: Mapping[str, str], name: str) -> str:
    """A text that is not empty; raises `StationError`."""
    if not asked.get(name):
        raise StationError(f"the request must have the parameter {name}")
    return asked[name]


def number(asked: Mapping[str, str], name: str) -> float:
    """A number; raises `StationError`."""
    found = text(asked, name)
    try:
        return float(found)
    except ValueError as error:
        raise StationError(f"{name} must be a number, got {found[:40]!r}") from error


def whole(asked: Mapping[str, str], name: str, least: int, most: int) -> int:
    """A whole number in the range; raises `StationError`."""
    found = text(asked, name)
    # Sixteen digits are enough for every allowed number.
    if not (found.isascii() and found.isdecimal()) or len(found) > 16 or not least <= int(found) <= most:
        raise StationError(f"{name} must be a whole number from {least} to {most}, got {found[:40]!r}")
    return int(found)
