"""Values of sensors that are not fitted (contract/vesc.py): null wherever samples are looked at."""

from __future__ import annotations

from collections import Counter

import numpy as np

from contract import ABSENT_FROM, absent
from station.blocks import Block
from station.conditions import Column


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
