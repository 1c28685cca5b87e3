"""Results as a table in a terminal."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Any, NamedTuple

from rich.table import Table

from iort_analysis.samples.positions import in_degrees
from iort_station.data import Result
from iort_station.recordings.tabular import texts_of_time
from iort_station.texts import visible

# A terminal shows the beginning and the end of a long result.
_SHOWN = 20
_TIME_WIDE = "2026-05-04 10:00:00.000000"
_GAP = 2
# Longer texts are folded.
_TEXT_WIDE = 40


class Shown(NamedTuple):
    """A table, and the fields that do not fit into it."""

    table: Table
    left_out: list[str]


def terminal(result: Result, width: int | None = None) -> Shown:
    """The first and last samples, with units, in lines of ``width`` characters.

    If the names do not fit, they break after underscores. Fields that do not fit then are left out.
    """
    n = len(result)
    chosen = [*range(n)] if n <= 2 * _SHOWN else [*range(_SHOWN), *range(n - _SHOWN, n)]
    times = texts_of_time(Result(result.robot, result.stream, result.times_us[chosen], {}))
    stamps = [text[:-1].replace("T", " ") for text in times]
    columns = [
        _Column(
            visible(name),
            result.unit(name),
            [_cell(column[i], 7 if in_degrees(name) else None) for i in chosen],
        )
        for name, column in result.columns.items()
    ]
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
        table.add_column(column.heading, justify="right", max_width=_TEXT_WIDE, overflow="fold")
    for place, row in enumerate(zip(stamps, *(column.cells for column in columns), strict=True)):
        if n > 2 * _SHOWN and place == _SHOWN:
            table.add_row("...", *["..."] * len(columns))
        table.add_row(*row)
    return Shown(table, left_out)


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


def _cell(value: Any, digits: int | None) -> str:
    if value is None or value != value:  # noqa: PLR0124 - NaN is not itself
        return "-"
    if isinstance(value, float):
        if digits is not None:
            return f"{value:.{digits}f}"
        return f"{value:.6g}" if abs(value) < 1e6 or not value.is_integer() else f"{value:.0f}"
    return visible(str(value))
