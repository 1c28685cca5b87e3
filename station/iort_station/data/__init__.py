"""Recorded samples: queried, listed by run, exported, and what the analysis says of them.

    from iort_station import data
    from iort_station.cloud import Cloud

    ride = data.query(Cloud.find(), "car7", "vesc", "-10m", "now", fields=["speed", "speed_mps"])
    ride.times_us, ride.columns["speed_mps"], ride.unit("speed"), ride.frame()

It uses the contract, `iort_station.fleet` for the registry, and `iort_station.cloud`.
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
