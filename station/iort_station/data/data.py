"""What the cars have recorded, as numpy's columns or a pandas frame.

    from iort_station.data import data
    from iort_station.cloud import Cloud

    ride = data.query(Cloud(), "car7", "vesc", "-10m", "now", fields=["speed", "speed_mps"])
    ride.times_us, ride.columns["speed_mps"], ride.frame()

A range includes its start and not its end, to the microsecond.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache, partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from iort_contract.catalog.derived import DERIVED
from iort_contract.messages.message_type import MessageType
from iort_station.cloud import Cloud
from iort_station.data import inventory, query_function, reading
from iort_station.data.blocks import Block, join
from iort_station.data.conditions import Column, derive, holds
from iort_station.data.reading import Told
from iort_station.data.resample import resample
from iort_station.data.seconds import seconds
from iort_station.data.selection import Selection, select
from iort_station.data.sensors import Sensors
from iort_station.data.stored import ATTRIBUTES, Refused, blocks
from iort_station.data.times import Time, duration_us
from iort_station.data.units import Driver, unit
from iort_station.errors import StationError

# Where samples are chosen: on this machine, or by the query function in the cloud.
CLIENT, LAMBDA = "client", "lambda"


@dataclass(frozen=True)
class Result:
    """Samples in order of time.

    ``times_us`` are int64 microseconds since the epoch, in order; ``columns`` one array a
    field: float64 with NaN for null, bool for flags, objects for texts. ``refused`` counts stored items
    that are not batches, of which ``reason`` says what was wrong with the first. ``absent`` counts by
    field values that were taken for null because their sensor is not fitted. ``ros2`` where charge and
    energy have the ROS 2 driver's units; ``kind_of`` tells the type of the stream's messages, where known,
    once a unit asks.
    """

    robot: str
    stream: str
    times_us: NDArray[np.int64]
    columns: Mapping[str, Column]
    refused: int = 0
    reason: str = ""
    ros2: bool = False
    absent: Mapping[str, int] = field(default_factory=dict)
    kind_of: Callable[[], MessageType | None] = field(default=lambda: None, repr=False, compare=False)

    def __len__(self) -> int:
        return len(self.times_us)

    def unit(self, name: str) -> str:
        """The unit of a column, empty where none is known."""
        return unit(self.stream, name, ros2=self.ros2, kind=self.kind_of())

    def frame(self) -> Any:
        """The same as a pandas DataFrame, indexed by time in UTC."""
        # Half a second of import that only those pay who ask for it.
        import pandas as pd  # noqa: PLC0415 - see above

        index = pd.to_datetime(self.times_us, unit="us", utc=True).rename("time")
        return pd.DataFrame(dict(self.columns), index=index)


def query(
    cloud: Cloud,
    robot: str,
    stream: str,
    start: Time | None = None,
    end: Time | None = None,
    *,
    fields: Sequence[str] | None = None,
    where: str | None = None,
    every: str | None = None,
    summary: bool = False,
    on: str = CLIENT,
    scan: bool = False,
    progress: Told | None = None,
) -> Result:
    """The samples of a robot's stream from ``start`` (included) to ``end`` (not included).

    Times are microseconds since the epoch, datetimes, or texts such as ``-10m`` and ISO 8601; None is
    the beginning or the end of what is stored. ``fields`` may name ``speed_mps`` and ``power_w``, which
    are derived with the robot's parameters, and so may ``where``, a condition in the language of
    `iort_contract.expression`. ``every`` (``"1s"``) puts samples together, see `iort_station.data.resample`.
    ``summary`` reads the seconds that Lambda 2 has written instead of samples; a field then stands for
    its ``_min``, ``_mean``, ``_max`` and ``_last``. ``on="lambda"`` has the query function choose the
    samples in the cloud. ``scan`` reads by Scan instead of by Query.

    Raises `StationError` for a robot, stream or field that is not there, naming those that are, and for
    a time or condition that cannot be read.
    """
    selection = select(robot, stream, start, end, fields=fields, where=where)
    every_us = duration_us(every) if every is not None else None
    refused, sensors = Refused(), Sensors()
    if on == LAMBDA:
        if summary:
            raise StationError("the query function reads samples; the summary is read from here")
        found = query_function.samples(
            cloud, selection, refused=refused, sensors=sensors, scan=scan, progress=progress
        )
    elif summary:
        found = seconds(cloud, selection, scan=scan, progress=progress)
    else:
        found = samples(cloud, selection, refused=refused, sensors=sensors, scan=scan, progress=progress)
    driver = Driver()
    found = driver.told(found)
    block = join(list(found)) if every_us is None else resample(found, every_us)
    if not len(block.times_us):
        inventory.check_there(cloud, robot, stream)
    return Result(
        robot,
        stream,
        block.times_us,
        block.columns,
        refused.count,
        refused.reason,
        driver.ros2,
        sensors.absent,
        cache(partial(inventory.kind_of, cloud, selection)),
    )


def samples(
    cloud: Cloud,
    selection: Selection,
    *,
    refused: Refused,
    sensors: Sensors | None = None,
    scan: bool = False,
    progress: Told | None = None,
    messages: bool = True,
) -> Iterator[Block]:
    """The selection's samples a block at a time, for what is too long to be held at once; without
    ``messages`` those alone that are no ROS messages.

    Values of ``sensors`` that are not fitted become null; without, they are as they were recorded.
    Raises `StationError` at the end where a field that was named was in none of the samples.
    """
    pages = reading.batches(cloud, selection, ATTRIBUTES, scan=scan)
    found = blocks(reading.told(pages, progress), refused, selection.needs, messages=messages)
    condition, fields, named = selection.condition, selection.fields, selection.named()
    derived = sorted(named & DERIVED.keys())
    vehicle = inventory.vehicle_of(cloud, selection.robot) if derived else None
    there: set[str] = set()
    some = False
    for whole in found:
        block = _trimmed(whole, selection)
        block = block if sensors is None else sensors.known(block)
        some = some or len(block.times_us) > 0
        columns = dict(block.columns)
        if derived:
            made = derive(columns, vehicle)
            columns |= {name: made[name] for name in derived if name in made}
        there |= columns.keys()
        chosen = Block(block.times_us, columns)
        if condition is not None:
            chosen = chosen.take(holds(condition, columns, len(block.times_us)))
        names = block.columns if fields is None else fields
        if len(chosen.times_us):
            yield Block(chosen.times_us, {name: _column(chosen, name) for name in names})
    if some:
        inventory.check_fields(cloud, selection, there)


def _trimmed(block: Block, selection: Selection) -> Block:
    times = block.times_us
    first = 0 if selection.start_us is None else int(times.searchsorted(selection.start_us))
    last = len(times) if selection.end_us is None else int(times.searchsorted(selection.end_us))
    return block if (first, last) == (0, len(times)) else block.take(slice(first, last))


def _column(block: Block, name: str) -> Column:
    """A column; null where these samples have none."""
    return block.columns[name] if name in block.columns else np.full(len(block.times_us), np.nan)
