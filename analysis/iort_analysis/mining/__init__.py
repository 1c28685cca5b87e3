"""The miners: each takes a drive and says what it found, and what it could not find and why.

A new one is a file and a line of `MINERS`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from types import MappingProxyType

from iort_analysis.drives.drive import Drive
from iort_analysis.results import Mined

Miner = Callable[[Drive], Mined]
# By the name that a result gives as missing if the miner fails.
MINERS: Mapping[str, Miner] = MappingProxyType({})
