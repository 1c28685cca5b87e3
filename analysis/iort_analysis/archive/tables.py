"""The tables of a drive's result as Parquet: columns as they are, texts and lists as JSON."""

from __future__ import annotations

import io
import json

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from iort_analysis.results import Table


def write_table(table: Table) -> bytes:
    """A table as a Parquet file."""
    columns = {
        name: pa.array(column if column.dtype.kind in "fiub" else _texts(column))
        for name, column in table.items()
    }
    file = io.BytesIO()
    pq.write_table(pa.table(columns), file, compression="zstd")
    return file.getvalue()


def read_table(content: bytes) -> dict[str, np.ndarray]:
    """The columns of a file that `write_table` wrote."""
    table = pq.read_table(io.BytesIO(content))
    return {name: table[name].to_numpy() for name in table.column_names}


def _texts(column: np.ndarray) -> list[str | None]:
    return [
        value if value is None or isinstance(value, str) else json.dumps(value) for value in column.tolist()
    ]
