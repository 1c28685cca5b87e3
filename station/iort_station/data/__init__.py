"""Recorded samples: queried, listed by run, exported, and what the analysis says of them.

It uses the contract, `iort_station.fleet` for the registry, and `iort_station.cloud`. Notebooks use
`iort_station.lab`, which offers it.
"""

from __future__ import annotations

from iort_analysis.samples.blocks import Block, values
from iort_station.data.queries import CLIENT, LAMBDA, Result, query, samples
from iort_station.data.recorded import Selection, select

__all__ = [
    "CLIENT",
    "LAMBDA",
    "Block",
    "Result",
    "Selection",
    "query",
    "samples",
    "select",
    "values",
]
