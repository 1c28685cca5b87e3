"""The operator's station: what people use to watch the cars, ask what happened and take the data home.

What is listed here is the library for programs and notebooks; all other modules are internal, and change
without notice. A name is imported when it is first used.

    from iort_station import connect

    ride = connect().query("car7", "vesc", "-10m", fields=["speed_mps", "power_w"])
    ride.pandas()
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from iort_station.lab import (
        Estimate,
        Finding,
        Incident,
        Lab,
        Laps,
        Message,
        Result,
        Robot,
        Run,
        StationError,
        Stream,
        UsageError,
        Verdict,
        connect,
    )

__all__ = [
    "Estimate",
    "Finding",
    "Incident",
    "Lab",
    "Laps",
    "Message",
    "Result",
    "Robot",
    "Run",
    "StationError",
    "Stream",
    "UsageError",
    "Verdict",
    "connect",
]


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module("iort_station.lab"), name)


def __dir__() -> list[str]:
    return __all__
