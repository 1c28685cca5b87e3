"""A drive as the miners see it: clean samples of all streams on one clock."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from iort_analysis.samples.blocks import Block, Column
from iort_contract.catalog.derived import Vehicle
from iort_contract.messages.analysis import DriveKey

# The kinds of repair: a pause between samples, a sample at a time that was there already, a sensor that
# reports its own failure, a value that stands still while the car moves, and a single value far from its
# neighbours.
GAP, SAME_TIME, SENSOR_FAULT, FROZEN, OUTLIER = "gap", "same_time", "sensor_fault", "frozen", "outlier"


class Repair(NamedTuple):
    """What the cleaning did to a field from ``start_us`` to ``end_us``, inclusive.

    ``samples`` counts the changed ones, or in a pause those that are missing. ``field`` is empty where a
    whole stream is meant. Outliers of a field are one repair.
    """

    kind: str
    stream: str
    field: str
    start_us: int
    end_us: int
    samples: int


@dataclass(frozen=True, eq=False)
class Drive:
    """One drive of a robot.

    ``streams`` are the clean samples of each stream on its own clock. ``samples`` are all numeric fields on
    one clock, that of the ``vesc`` stream: a column ``<stream>.<field>`` each, float64 with NaN where nothing
    is known. ``vesc`` and ``pose`` name the streams with a motor controller's fields and with a position;
    None without one. ``vehicle`` has the robot's registered parameters; ``known`` has further numbers of the
    car by their names, such as ``mass_kg`` and ``cells``, and may be empty. ``raw`` are the samples as
    recorded, and ``repairs`` what the cleaning changed in them: a frozen sensor is to be seen there.
    """

    key: DriveKey
    end_us: int
    streams: Mapping[str, Block]
    samples: Block
    vesc: str | None = None
    pose: str | None = None
    vehicle: Vehicle | None = None
    known: Mapping[str, float] = field(default_factory=dict)
    raw: Mapping[str, Block] = field(default_factory=dict)
    repairs: Sequence[Repair] = ()

    @property
    def seconds(self) -> NDArray[np.float64]:
        """The time of each of ``samples`` since the first one, in seconds."""
        times = self.samples.times_us
        return (times - times[:1]) / 1e6

    def of(self, stream: str | None, name: str) -> Column | None:
        """A field of a stream on the one clock; None if it is not there, or has no value."""
        column = self.samples.columns.get(f"{stream}.{name}")
        return None if column is None or bool(np.isnan(column).all()) else column
