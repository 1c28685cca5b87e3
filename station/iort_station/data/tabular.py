"""Results as CSV, JSON Lines and Parquet."""

from __future__ import annotations

import csv
import json
from collections.abc import Iterator, Sequence
from typing import IO, Any

import numpy as np

from iort_analysis.samples.blocks import Column, values
from iort_contract.codec import EXACT
from iort_station.data import Result
from iort_station.output import visible

_CHUNK = 10_000
# Characters that begin a formula in a spreadsheet, also in full width: OWASP, "CSV Injection".
_FORMULA = ("=", "+", "-", "@", "\uff1d", "\uff0b", "\uff0d", "\uff20")


def texts_of_time(result: Result) -> list[str]:
    """The times as ISO 8601 in UTC, to the microsecond."""
    times = result.times_us.astype("datetime64[us]")
    return [f"{text}Z" for text in np.datetime_as_string(times, unit="us").tolist()]


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
            sample = {"time": at, "time_us": next(times), **dict(zip(names, row, strict=True))}
            file.write(json.dumps(sample) + "\n")


def to_parquet(result: Result, file: IO[bytes]) -> None:
    """Write the samples as `Result.arrow` has them."""
    # A third of a second of import.
    import pyarrow.parquet as pq  # noqa: PLC0415 - see above

    pq.write_table(result.arrow(), file, compression="zstd")


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
