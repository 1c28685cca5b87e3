"""The columns of the archive's files: their names, and their values as arrays of Arrow and of numpy.

A field is a column of its own name. What belongs to a batch or a message is in columns whose names begin with
an underscore, which no field's does; they repeat for each row, which costs nearly nothing in Parquet."""

from __future__ import annotations

import io
import json
from collections.abc import Sequence
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from iort_analysis.results import Table
from iort_analysis.samples.blocks import Column, column_of, objects
from iort_contract.codec import EXACT
from iort_contract.limits import Value

TIME = "time"
BATCH_ID, RECEIVED, NOT_FINITE, PREVIOUS_RUNS = "_batch", "_received_ms", "_nonfinite", "_previous"
# The hash of the stored item.
HASH = "_sha256"
# The batch's fields, in order and separated by commas. Behind a bar are those beside the ROS messages, which
# hold the others.
FIELDS = "_fields"
# What is needed to rebuild ROS messages from fields; or the messages, their type and its layout.
ABOUT, TYPE, LAYOUT, MESSAGE = "_about", "_type", "_layout", "_message"
# JSON objects of the fields that got no column, since the hour has too many.
OTHER = "_other"
MAX_COLUMNS = 2000
_TEXT = pa.dictionary(pa.int32(), pa.string())
# The columns that every file has.
OWN = {
    TIME: pa.timestamp("us", tz="UTC"),
    BATCH_ID: _TEXT,
    RECEIVED: pa.int64(),
    NOT_FINITE: pa.int32(),
    PREVIOUS_RUNS: _TEXT,
    HASH: _TEXT,
    FIELDS: _TEXT,
    ABOUT: _TEXT,
    TYPE: _TEXT,
    LAYOUT: _TEXT,
    MESSAGE: pa.binary(),
    OTHER: pa.string(),
}
# In a column's metadata: the field's name, its unit and meaning, and whether its texts are JSON.
FIELD, UNIT, MEANING, ENCODING = b"iort:field", b"iort:unit", b"iort:meaning", b"iort:encoding"
JSON = b"json"
# The kinds of a field's column. `NOTHING` is null everywhere, `VARIED` a number with many different values,
# `MIXED` JSON. A number is always a float64: tools that read many files expect one type.
NOTHING, NUMBER, VARIED, FLAG, TEXT, MIXED = "nothing", "number", "varied", "flag", "text", "mixed"
# A dictionary of a column's values suits a number with fewer different values than this share of its rows.
_VARIED = 0.05
TYPES = {
    NOTHING: pa.float64(),
    NUMBER: pa.float64(),
    VARIED: pa.float64(),
    FLAG: pa.bool_(),
    TEXT: pa.string(),
    MIXED: pa.string(),
}
_COMPACT = json.JSONEncoder(separators=(",", ":"), ensure_ascii=False)


def column_name(field: str) -> str:
    """The column of a field: its name, except for a field that is called like the column of the times."""
    return f"_{field}" if field.lower() == TIME else field


def named(field: str) -> str:
    """The column of a field in a table on its way: no name of `OWN` begins like this."""
    return f"/{field}"


def wire(value: Value) -> Value:
    """A value as it was on the wire, where a whole number was an integer; NaN stands for null."""
    if type(value) is float:
        if value != value:  # noqa: PLR0124 - NaN
            return None
        if value.is_integer() and -EXACT < value < EXACT:
            return int(value)
    return value


def kind_of(column: Column) -> str:
    """The kind of a column."""
    if column.dtype.kind == "f":
        if np.isnan(column).all():
            return NOTHING
        return VARIED if len(np.unique(column)) > _VARIED * len(column) else NUMBER
    if column.dtype.kind == "b":
        return FLAG
    kinds = set(map(type, column)) - {type(None)}
    if kinds <= {str}:
        return TEXT if kinds else NOTHING
    if kinds == {bool}:
        return FLAG
    if kinds <= {int, float} and not any(type(v) is int and abs(v) >= EXACT for v in column):
        return NUMBER
    return MIXED


def joined_kind(one: str, other: str) -> str:
    """The kind that holds the values of both."""
    if NOTHING in (one, other):
        return one if other == NOTHING else other
    if {one, other} == {NUMBER, VARIED}:
        return VARIED
    return one if one == other else MIXED


def to_arrow(column: Column, kind: str) -> Any:
    """A column as an array of its kind's type."""
    if kind == MIXED:
        return pa.array(
            [None if (v := wire(value)) is None else _COMPACT.encode(v) for value in column.tolist()]
        )
    return pa.array(column, type=TYPES[kind], from_pandas=True)


def cast(array: Any, kind: str, into: str) -> Any:
    """An array of a kind as one of another kind that holds it too."""
    if kind == into or {kind, into} == {NUMBER, VARIED}:
        return array
    if kind == NOTHING:
        return pa.nulls(len(array), TYPES[into])
    return to_arrow(objects(array.to_pylist()), into)


def to_values(array: Any, *, is_json: bool) -> list[Value]:
    """A field's array as values of the wire."""
    if is_json:
        return [None if text is None else json.loads(text) for text in array.to_pylist()]
    return list(map(wire, array.to_pylist()))


def to_numpy(array: Any, *, is_json: bool) -> Column:
    """A field's array as a column of a `Block`, of the type that the stored batches' columns have."""
    if is_json:
        return column_of(to_values(array, is_json=True))
    if array.null_count == len(array):
        return np.full(len(array), np.nan)
    if pa.types.is_floating(array.type):
        numbers: Column = array.to_numpy(zero_copy_only=False)
        return numbers
    return column_of(array.to_pylist()) if pa.types.is_boolean(array.type) else objects(array.to_pylist())


def repeated(values: Sequence[Any], counts: Any, kind: Any) -> Any:
    """A column of what belongs to batches: each value as often as the batch has samples."""
    rows = np.repeat(np.arange(len(values), dtype=np.int32), counts)
    if not pa.types.is_dictionary(kind):
        return pa.array(values, type=kind).take(pa.array(rows))
    distinct: dict[Any, int | None] = {None: None}
    codes = [distinct.setdefault(value, len(distinct) - 1) for value in values]
    indices = pa.array(codes, type=pa.int32()).take(pa.array(rows))
    names = pa.array(list(distinct)[1:], type=pa.string())
    return pa.DictionaryArray.from_arrays(indices, names)


def runs(array: Any) -> tuple[list[Any], Any]:
    """The values of a column of `repeated`, once each; and the first row of each, and the end."""
    indices = np.asarray(array.indices if pa.types.is_dictionary(array.type) else array)
    starts = np.flatnonzero(np.append(True, indices[1:] != indices[:-1])) if len(indices) else indices[:0]
    return array.take(pa.array(starts)).to_pylist(), np.append(starts, len(indices))


# The tables of a drive's result as Parquet: columns as they are, texts and lists as JSON.


def write_table(table: Table) -> bytes:
    """A table as a Parquet file."""
    columns = {
        name: pa.array(
            column
            if column.dtype.kind in "fiub"
            else [v if v is None or isinstance(v, str) else json.dumps(v) for v in column.tolist()]
        )
        for name, column in table.items()
    }
    file = io.BytesIO()
    pq.write_table(pa.table(columns), file, compression="zstd")
    return file.getvalue()
