"""A race track: its centre line and its widths, in the CSV format of F1TENTH's and TU Munich's tools."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Iterator, Mapping

from iort_contract.checks import shown
from iort_contract.limits import ContractError

MAX_POINTS = 20_000
_LEAST_POINTS = 4
# A track of 1:10 cars is below a hundred metres, a real one below ten kilometres.
_MAX_M = 100_000.0
_COLUMNS = ("x_m", "y_m", "w_right_m", "w_left_m")


@dataclass(frozen=True)
class Track:
    """Points of a closed centre line, in the order of driving; after the last one comes the first.

    ``w_right_m`` and ``w_left_m`` are the distances from the line to the track's edges.
    """

    x_m: tuple[float, ...]
    y_m: tuple[float, ...]
    w_right_m: tuple[float, ...]
    w_left_m: tuple[float, ...]

    def csv(self) -> str:
        """The track as `parse_track` reads it, to the millimetre."""
        rows = zip(self.x_m, self.y_m, self.w_right_m, self.w_left_m)
        lines = [f"# {', '.join(_COLUMNS)}", *(", ".join(f"{value:.3f}" for value in row) for row in rows)]
        return "\n".join(lines) + "\n"


def parse_track(text: str) -> Track:
    """Read a CSV file of four columns: x, y, width to the right, width to the left, in metres.

    Commas or semicolons separate them. Lines that begin with ``#`` are comments, and a first line of names
    is skipped. Raises `ContractError`, which names the line.
    """
    rows = list(_rows(text))
    if len(rows) > 1 and rows[0][:2] == rows[-1][:2]:
        # Some tools repeat the first point, to close the line.
        rows.pop()
    if not _LEAST_POINTS <= len(rows) <= MAX_POINTS:
        raise ContractError(f"a track must have {_LEAST_POINTS} to {MAX_POINTS} points, got {len(rows)}")
    return Track(*(tuple(column) for column in zip(*rows)))


def track_of(columns: Mapping[str, Any]) -> Track:
    """A track of four lists, by their names. Raises `ContractError`."""
    lists = [values for values in map(columns.get, _COLUMNS) if isinstance(values, list)]
    if set(columns) != set(_COLUMNS) or len(lists) != len(_COLUMNS):
        raise ContractError(f"a track must be the four lists {', '.join(_COLUMNS)}, got {shown(columns)}")
    if len(set(map(len, lists))) != 1:
        raise ContractError(f"the lists of a track must be equally long, got {list(map(len, lists))}")
    return parse_track("\n".join(", ".join(map(repr, row)) for row in zip(*lists)))


def _rows(text: str) -> Iterator[tuple[float, ...]]:
    first, before = True, None
    for number, line in enumerate(text.splitlines(), 1):
        cells = [cell.strip() for cell in line.replace(";", ",").split(",")]
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        names, first = first and not any(map(_is_number, cells)), False
        if names:
            continue
        if len(cells) != len(_COLUMNS) or not all(map(_is_number, cells)):
            raise ContractError(
                f"line {number} must be the four numbers {', '.join(_COLUMNS)}, got {shown(line)}"
            )
        row = tuple(map(float, cells))
        if not all(abs(value) <= _MAX_M for value in row):
            raise ContractError(f"line {number} must be within {_MAX_M:g} m, got {shown(line)}")
        if min(row[2:]) <= 0:
            raise ContractError(f"line {number}: widths must be over 0 m, got {shown(line)}")
        if row[:2] != before:
            yield row
        before = row[:2]


def _is_number(cell: str) -> bool:
    try:
        return not math.isnan(float(cell))
    except ValueError:
        return False
