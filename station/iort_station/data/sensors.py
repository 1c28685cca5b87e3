"""Values of sensors that are not fitted (`iort_contract.vesc`): null wherever samples are looked at."""

from __future__ import annotations

from collections import Counter

import numpy as np

from iort_contract.catalog.vesc import ABSENT_FROM, absent
from iort_station.data.blocks import Block
from iort_station.data.conditions import Column


class Sensors:
    """Takes such values for null, and counts them by field."""

    def __init__(self) -> None:
        self.absent: Counter[str] = Counter()

    def known(self, block: Block) -> Block:
        """The samples without them."""
        found: dict[str, Column] = {}
        for name in block.columns.keys() & ABSENT_FROM.keys():
            column = block.columns[name]
            numbers = column.dtype.kind == "f"
            if numbers:
                mask = column <= ABSENT_FROM[name]
            else:
                mask = np.array([absent(name, value) for value in column.tolist()], dtype=np.bool_)
            if mask.any():
                found[name] = column.copy()
                found[name][mask] = np.nan if numbers else None
                self.absent[name] += int(mask.sum())
        return Block(block.times_us, {**block.columns, **found}) if found else block
