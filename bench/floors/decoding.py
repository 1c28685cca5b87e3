"""The floor of the analysis: the values of stored batches as numpy's columns, by the barest code.

It checks nothing: neither the batches nor their order, overlap, gaps or clock. It cleans and mines nothing.
"""

from __future__ import annotations

import base64
import json
import zlib
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from iort_contract.codec import DICTIONARY


def columns(items: Sequence[Mapping[str, Any]]) -> dict[str, NDArray[np.float64]]:
    """The columns of stored items whose fields are the same, in this order."""
    parts: dict[str, list[NDArray[np.float64]]] = {}
    for item in items:
        deflated = base64.b64decode(item["samples"]["S"])
        fields = json.loads(zlib.decompressobj(zdict=DICTIONARY).decompress(deflated))["fields"]
        for name, (decimals, *steps) in fields.items():
            parts.setdefault(name, []).append(np.cumsum(steps) / 10**decimals)
    return {name: np.concatenate(some) for name, some in parts.items()}
