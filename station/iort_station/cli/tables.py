"""Results as a table, CSV, JSON Lines and Parquet."""

from __future__ import annotations

import csv
import itertools
import json
from collections.abc import Iterator, Sequence
from typing import IO, Any, NamedTuple

import numpy as np
from rich.table import Table

from iort_contract.codec.columns import EXACT
from iort_station.cli.words import visible
from iort_station.data import Result
from iort_station.data.blocks import Column, values
from iort_station.data.positions import in_degrees

# A terminal shows the beginning and the end of a long result.
_SHOWN = 20
_TIME_WIDE = "2026-05-04 10:00:00.000000"
_GAP = 2
# Longer texts are folded.
_TEXT_WIDE = 40
_CHUNK = 10_000
# Characters that begin a formula in a spreadsheet, also in full width: OWASP, "CSV Injection".
_FORMULA = ("=", "+", "-", "@", "\uff1d", "\uff0b", "\uff0d", "\uff20")


def texts_of_time(result: Result) -> list[str]:
    """The times as ISO 8601 in UTC, to the microsecond."""
    times = result.times_us.astype("datetime64[us]")
    return [f"{text}Z" for text in np.datetime_as_string(times, unit="us").tolist()]


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


def to_csv(result: Result, file: IO[str], *, raw: bool = False) -> None:
    """Write a header and a line for each sample; null is empty.

    Names and texts are `harmless`, because a spreadsheet runs formulas. ``raw`` leaves them unchanged.
    """
    writer = csv.writer(file, lineterminator="\n")
    writer.writerow(["time", *(result.columns if raw else map(harmless, result.columns))])
    for rows in _rows(result):
        writer.writerows(rows if raw else ([harmless(value) for value in row] for row in rows))


def harmless(value: Any) -> Any:
    """A text without formulas and control sequences; other values unchanged."""
    if not isinstance(value, str):
        return value
    text = visible(value)
    return f"'{text}" if text.lstrip().startswith(_FORMULA) else text


def to_json_lines(result: Result, file: IO[str]) -> None:
    """Write an object a line: the time, the time in microseconds, and the fields."""
    names = list(result.columns)
    times = iter(result.times_us.tolist())
    for rows in _rows(result):
        for at, *row in rows:
            sample = {"time": at, "t_us": next(times), **dict(zip(names, row, strict=True))}
            file.write(json.dumps(sample) + "\n")


def to_parquet(result: Result, file: IO[bytes]) -> None:
    """Write ``time`` (microseconds, UTC) and a column for each field, with units in the metadata."""
    # A third of a second of import.
    import pyarrow as pa  # noqa: PLC0415 - see above
    import pyarrow.parquet as pq  # noqa: PLC0415 - as above

    arrays = [pa.array(result.times_us, type=pa.timestamp("us", tz="UTC"))]
    fields = [pa.field("time", arrays[0].type, nullable=False)]
    for name, column in result.columns.items():
        array = pa.array(column, from_pandas=True)
        unit = result.unit(name)
        fields.append(pa.field(name, array.type, metadata={"unit": unit} if unit else None))
        arrays.append(array)
    schema = pa.schema(fields, metadata={"robot": result.robot, "stream": result.stream})
    pq.write_table(pa.Table.from_arrays(arrays, schema=schema), file, compression="zstd")


def _rows(result: Result) -> Iterator[list[Sequence[Any]]]:
    """Times and values in chunks: Python's values take ten times the memory of numpy's."""
    whole = {name for name, column in result.columns.items() if _is_whole(column)}
    for first in range(0, len(result), _CHUNK):
        chunk = slice(first, first + _CHUNK)
        part = Result(result.robot, result.stream, result.times_us[chunk], {})
        columns = [
            [int(value) if isinstance(value, float) else value for value in values(column[chunk])]
            if name in whole
            else values(column[chunk])
            for name, column in result.columns.items()
        ]
        yield list(zip(texts_of_time(part), *columns, strict=True))


def _is_whole(column: Column) -> bool:
    """Whether all numbers of a column are integers, which arrive as float64."""
    if column.dtype.kind == "f":
        known = column[~np.isnan(column)]
        return bool((known == np.floor(known)).all() and (np.abs(known) < EXACT).all())
    floats = [value for value in column.tolist() if isinstance(value, float)]
    return all(value.is_integer() and abs(value) < EXACT for value in floats)


def _cell(value: Any, digits: int | None) -> str:
    if value is None or value != value:  # noqa: PLR0124 - NaN is not itself
        return "-"
    if isinstance(value, float):
        if digits is not None:
            return f"{value:.{digits}f}"
        return f"{value:.6g}" if abs(value) < 1e6 or not value.is_integer() else f"{value:.0f}"
    return visible(str(value))
