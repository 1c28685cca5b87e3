"""The way back from the archive's files to stored items: slow, and for whoever needs whole batches."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from iort_analysis.archive import columns as names
from iort_analysis.archive.columns import MIXED, named, runs, to_values
from iort_analysis.archive.reading import ArchiveFile, head_of
from iort_contract.archive import Hour
from iort_contract.codec import CODEC, SERIALIZED_CODEC, packed_samples
from iort_contract.dynamodb import Item
from iort_contract.limits import BATCH_VERSION, Value
from iort_contract.ros1.message import Messages, pack
from iort_contract.tables import BATCH, SAMPLES, TOPIC


def items(file: ArchiveFile, topic: str, hour: Hour | None = None) -> Iterator[Item]:
    """The batches of a file as stored items.

    They decode to the same batches and ROS messages as the stored ones, but may be compressed in another way;
    each has the hash of the stored one as the contract's `HASH`.
    """
    for group in file.groups(hour):
        table = file.table(group)
        ids, rows = runs(table[names.BATCH_ID])
        columns = _Columns(file.kinds, table)
        for i, batch in enumerate(ids):
            start, end = int(rows[i]), int(rows[i + 1])
            codec, samples = columns.samples(start, end)
            yield {
                TOPIC: {"S": topic},
                BATCH: {"S": batch},
                "v": {"N": str(BATCH_VERSION)},
                SAMPLES: {"N": str(end - start)},
                "codec": {"S": codec},
                "samples": {"S": samples},
                **head_of(table, start),
            }


class _Columns:
    """A table's fields as values of the wire."""

    def __init__(self, kinds: Mapping[str, str], table: Any) -> None:
        self._kinds, self._table = kinds, table
        self._times = table[names.TIME].cast("int64").to_numpy()

    def samples(self, start: int, end: int) -> tuple[str, str]:
        """The codec and the samples of the batch in these rows."""
        beside = str(self._table[names.FIELDS][start].as_py()).rpartition("|")[2]
        dt = [0, *np.diff(self._times[start:end]).tolist()]
        layout = self._table[names.LAYOUT][start].as_py()
        fields = {name: self._values(name, start, end) for name in beside.split(",") if name}
        if layout is None:
            about = self._table[names.ABOUT][start].as_py() or ""
            return CODEC, packed_samples(dt, fields, about.encode())
        kind = self._table[names.TYPE][start].as_py()
        raw = self._table[names.MESSAGE].slice(start, end - start).to_pylist()
        return SERIALIZED_CODEC, packed_samples(
            dt, fields, pack(Messages(kind, layout, raw)), SERIALIZED_CODEC
        )

    def _values(self, name: str, start: int, end: int) -> Sequence[Value]:
        if name not in self._kinds:
            others = self._table[names.OTHER].slice(start, end - start).to_pylist()
            return [json.loads(text or "{}").get(name) for text in others]
        array = self._table[named(name)].slice(start, end - start)
        return to_values(array, is_json=self._kinds[name] == MIXED)
