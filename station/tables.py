"""Results as people and other programs read them: a table, CSV, JSON Lines and Parquet."""

from __future__ import annotations

import csv
import json
from collections.abc import Iterator, Sequence
from typing import IO, Any

import numpy as np
from rich.table import Table

from station.conditions import values
from station.data import Result

# Of a long result a terminal shows the beginning and the end.
_SHOWN = 20
_CHUNK = 10_000


def texts_of_time(result: Result) -> list[str]:
    """The times as ISO 8601 in UTC, to the microsecond."""
    times = result.times_us.astype("datetime64[us]")
    return [f"{text}Z" for text in np.datetime_as_string(times, unit="us").tolist()]


def terminal(result: Result) -> Table:
    """The first and last samples, with units."""
    table = Table(box=None, pad_edge=False, header_style="bold", caption_justify="left")
    table.add_column("time (UTC)", no_wrap=True)
    for name in result.columns:
        unit = result.unit(name)
        table.add_column(f"{name}\n{unit}" if unit else name, justify="right")
    n = len(result)
    chosen = range(n) if n <= 2 * _SHOWN else [*range(_SHOWN), *range(n - _SHOWN, n)]
    times, columns = texts_of_time(result), list(result.columns.values())
    for place, i in enumerate(chosen):
        if n > 2 * _SHOWN and place == _SHOWN:
            table.add_row("...", *["..."] * len(columns))
        table.add_row(times[i][:-1].replace("T", " "), *(_cell(column[i]) for column in columns))
    return table


def to_csv(result: Result, file: IO[str]) -> None:
    """A header and a line a sample; what is null is empty."""
    writer = csv.writer(file, lineterminator="\n")
    writer.writerow(["time", *result.columns])
    for rows in _rows(result):
        writer.writerows(rows)


def to_json_lines(result: Result, file: IO[str]) -> None:
    """An object a line: the time, the same in microseconds, and the fields."""
    names = list(result.columns)
    times = iter(result.times_us.tolist())
    for rows in _rows(result):
        for at, *row in rows:
            sample = {"time": at, "t_us": next(times), **dict(zip(names, row, strict=True))}
            file.write(json.dumps(sample) + "\n")


def to_parquet(result: Result, file: IO[bytes]) -> None:
    """A column a field beside ``time`` (microseconds, UTC); units are in the fields' metadata."""
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
    """Times and values, a chunk at a time: Python's values take ten times numpy's room."""
    for first in range(0, len(result), _CHUNK):
        chunk = slice(first, first + _CHUNK)
        part = Result(result.robot, result.stream, result.times_us[chunk], {})
        columns = [values(column[chunk]) for column in result.columns.values()]
        yield list(zip(texts_of_time(part), *columns, strict=True))


def _cell(value: Any) -> str:
    if value is None or value != value:  # noqa: PLR0124 - NaN is not itself
        return "-"
    if isinstance(value, float):
        return f"{value:.6g}" if abs(value) < 1e6 or not value.is_integer() else f"{value:.0f}"
    return str(value)
