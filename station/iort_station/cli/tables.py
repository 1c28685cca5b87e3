"""Results as a table in a terminal."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple, TextIO

from rich.table import Table

from iort_analysis.samples.positions import in_degrees
from iort_station.cli.console import Lines
from iort_station.data import Result
from iort_station.data.tabular import texts_of_time
from iort_station.output import one_line

# A terminal shows the beginning and the end of a long result: this many rows each.
_ENDS = 20
# A file's columns are as wide as in this many rows.
_MEASURED = 1_000
_TIME_WIDE = "2026-05-04 10:00:00.000000"
_GAP = 2
# Longer texts are folded.
_TEXT_WIDE = 40


class Shown(NamedTuple):
    """A table, how many samples it has, and the fields that do not fit into it."""

    table: Table
    rows: int
    left_out: list[str]


def plain(result: Result, file: TextIO) -> None:
    """Write every sample and field, with units, in lines of any width: for files and pipes.

    rich would take two milliseconds a line.
    """
    columns = _columns(result, range(min(len(result), _MEASURED)))
    widths = [column.width for column in columns]

    def write(stamp: str, values: Iterable[str]) -> None:
        cells = [value.rjust(width) for value, width in zip(values, widths, strict=True)]
        print(stamp.ljust(len(_TIME_WIDE)), *cells, sep=" " * _GAP, file=file)

    write("time (UTC)", [column.name for column in columns])
    write("", [column.unit or "" for column in columns])
    for start in range(0, len(result), _MEASURED):
        rows = range(start, min(start + _MEASURED, len(result)))
        cells = [column.cells for column in _columns(result, rows)]
        for stamp, *values in zip(_stamps(result, rows), *cells, strict=True):
            write(stamp, values)


def terminal(result: Result, width: int | None = None) -> Shown:
    """The first and last samples, with units, in lines of ``width`` characters.

    If the names do not fit, they break after underscores. Fields that do not fit then are left out.
    """
    n = len(result)
    chosen = [*range(n)] if n <= 2 * _ENDS else [*range(_ENDS), *range(n - _ENDS, n)]
    stamps, columns = _stamps(result, chosen), _columns(result, chosen)
    room = None if width is None else width - len(_TIME_WIDE)
    if room is not None and sum(_GAP + column.width for column in columns) > room:
        columns = [column._replace(name=column.name.replace("_", "_\n")) for column in columns]
        ends = itertools.accumulate(_GAP + column.width for column in columns)
        # The first field is always shown.
        fitting = max(1, sum(end <= room for end in ends))
        columns, left_out = columns[:fitting], list(result.columns)[fitting:]
    else:
        left_out = []
    table = Table(box=None, pad_edge=False, header_style="bold")
    table.add_column("time (UTC)", no_wrap=True)
    for column in columns:
        table.add_column(Lines(column.heading), justify="right", max_width=_TEXT_WIDE, overflow="fold")
    for place, row in enumerate(zip(stamps, *(column.cells for column in columns), strict=True)):
        if n > 2 * _ENDS and place == _ENDS:
            table.add_row("...", *["..."] * len(columns))
        table.add_row(*row)
    return Shown(table, len(chosen), left_out)


class _Column(NamedTuple):
    name: str
    unit: str | None
    cells: Sequence[str]

    @property
    def heading(self) -> str:
        return f"{self.name}\n{self.unit}" if self.unit else self.name

    @property
    def width(self) -> int:
        return min(_TEXT_WIDE, max(map(len, [*self.heading.split("\n"), *self.cells])))


def _columns(result: Result, rows: Sequence[int]) -> list[_Column]:
    return [
        _Column(
            one_line(name),
            result.unit(name),
            [_cell(column[i], 7 if in_degrees(name) else None) for i in rows],
        )
        for name, column in result.columns.items()
    ]


def _stamps(result: Result, rows: Sequence[int]) -> list[str]:
    times = texts_of_time(Result(result.robot, result.stream, result.times_us[[*rows]], {}))
    return [text[:-1].replace("T", " ") for text in times]


def _cell(value: Any, digits: int | None) -> str:
    if value is None or value != value:  # noqa: PLR0124 - NaN is not itself
        return "-"
    if isinstance(value, float):
        if digits is not None:
            return f"{value:.{digits}f}"
        return f"{value:.6g}" if abs(value) < 1e6 or not value.is_integer() else f"{value:.0f}"
    return one_line(str(value))
