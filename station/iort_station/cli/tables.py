"""Results as a table of text: of every sample and field in a file, or as much as a terminal shows."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple, TextIO

from iort_analysis.samples.positions import in_degrees
from iort_station.data import Result
from iort_station.data.tabular import texts_of_time
from iort_station.output import one_line

# A terminal shows the beginning and the end of a long result: this many rows each.
_ENDS = 20
# Columns are as wide as in this many rows, and at most so many characters; a terminal cuts longer texts.
_MEASURED, _TEXT_WIDE = 1_000, 40
_TIME_WIDE = len("2026-05-04 10:00:00.000000")
_GAP = "  "


class Shown(NamedTuple):
    """How many samples were written, and the fields that had no room."""

    rows: int
    left_out: list[str]


def write(result: Result, file: TextIO, width: int | None = None) -> Shown:
    """Write samples with units, in columns; in lines of ``width`` characters only the first and last samples,
    and the fields that fit. The first field is always written."""
    rows: Sequence[int] = range(len(result))
    cut = width is not None and len(rows) > 2 * _ENDS
    if cut:
        rows = [*rows[:_ENDS], *rows[-_ENDS:]]
    names, widths, room = list[str](), list[int](), (width or 0) - _TIME_WIDE
    for name in result.columns:
        texts = [one_line(name), result.unit(name), *_cells(result, name, rows[:_MEASURED])]
        wide = min(_TEXT_WIDE, max(map(len, texts)))
        room -= len(_GAP) + wide
        if width is None or room >= 0 or not names:
            names.append(name)
            widths.append(wide)

    def line(stamp: str, cells: Sequence[str]) -> None:
        if width is not None:
            cells = [cell if len(cell) <= _TEXT_WIDE else f"{cell[: _TEXT_WIDE - 3]}..." for cell in cells]
        texts = [cell.rjust(wide) for cell, wide in zip(cells, widths, strict=True)]
        print(stamp.ljust(_TIME_WIDE), *texts, sep=_GAP, file=file)

    line("time (UTC)", list(map(one_line, names)))
    line("", [result.unit(name) for name in names])
    for start in range(0, len(rows), _MEASURED):
        part = rows[start : start + _MEASURED]
        times = texts_of_time(Result(result.robot, result.stream, result.times_us[[*part]], {}))
        columns = [_cells(result, name, part) for name in names]
        for place, (time, *cells) in enumerate(zip(times, *columns, strict=True)):
            if cut and place == _ENDS:
                line("...", ["..."] * len(names))
            line(time[:-1].replace("T", " "), cells)
    return Shown(len(rows), [name for name in result.columns if name not in names])


def _cells(result: Result, name: str, rows: Sequence[int]) -> list[str]:
    column, digits = result.columns[name], 7 if in_degrees(name) else None
    return [_cell(column[i], digits) for i in rows]


def _cell(value: Any, digits: int | None) -> str:
    if value is None or value != value:  # noqa: PLR0124 - NaN is not itself
        return "-"
    if isinstance(value, float):
        if digits is not None:
            return f"{value:.{digits}f}"
        return f"{value:.6g}" if abs(value) < 1e6 or not value.is_integer() else f"{value:.0f}"
    return one_line(str(value))
