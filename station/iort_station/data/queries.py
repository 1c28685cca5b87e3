"""Queries: recorded samples as numpy arrays or a pandas frame, selected here or by functions/query.py."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache, partial
from typing import TYPE_CHECKING, cast

import numpy as np
from numpy.typing import NDArray

from iort_analysis.archive.stored import AUTO, Origin, PageProgress, Source
from iort_analysis.samples.batches import in_order
from iort_analysis.samples.blocks import Block, Column, join, resample, values
from iort_contract.catalog.derived import DERIVED
from iort_contract.catalog.vesc import ABSENT_FROM, VESC_FIELDS
from iort_contract.catalog.vesc import absent as is_absent
from iort_contract.dynamodb import with_samples_between
from iort_contract.ros.message import MessageType
from iort_contract.tables import STATS
from iort_station.cloud import Cloud
from iort_station.data import inventory
from iort_station.data.conditions import derive, holds
from iort_station.data.inventory import unit
from iort_station.data.recorded import Recorded, Selection, select
from iort_station.data.remote import by_function, check_in_table
from iort_station.data.seconds import in_column_order, seconds
from iort_station.errors import StationError
from iort_station.fleet import registry
from iort_station.times import Time, duration_us

if TYPE_CHECKING:
    import pandas as pd
    import polars as pl
    import pyarrow as pa

# Where samples are selected: on this machine, or by the query function in the cloud.
CLIENT, LAMBDA = "client", "lambda"
_BY_DRIVER = tuple(field.name for field in VESC_FIELDS.values() if field.ros2_unit is not None)
_MEAN = f"_{STATS[1]}"


@dataclass(frozen=True)
class Result:
    """Samples in order of time.

    ``times_us`` are int64 microseconds since the epoch. ``columns`` has an array per field: float64 with NaN
    for null, bool for flags, objects for texts. ``refused`` counts what is stored and cannot be read;
    ``reason`` names the first: topic, time and error. ``absent`` counts values by field that became null
    because their sensor is not fitted. ``ros2`` tells that charge and energy have the ROS 2 driver's units.
    ``origin`` tells what came from the archive. ``samples`` counts what was read: more than there are rows
    if ``every`` has averaged it.
    """

    robot: str
    stream: str
    times_us: NDArray[np.int64]
    columns: Mapping[str, Column]
    refused: int = 0
    reason: str = ""
    ros2: bool = False
    absent: Mapping[str, int] = field(default_factory=dict)
    origin: Origin = field(default_factory=Origin)
    samples: int = 0
    # The type of the stream's messages, if known.
    _kind_of: Callable[[], MessageType | None] = field(default=lambda: None, repr=False, compare=False)

    def __len__(self) -> int:
        return len(self.times_us)

    def unit(self, name: str) -> str:
        """The unit of a column; empty if unknown."""
        return unit(self.stream, name, ros2=self.ros2, kind=self._kind_of())

    def pandas(self) -> pd.DataFrame:
        """The samples as a DataFrame, indexed by ``time`` in UTC, with a column for each field."""
        # The import takes half a second.
        import pandas as pd  # noqa: PLC0415 - see above

        index = pd.to_datetime(self.times_us, unit="us", utc=True).rename("time")
        return pd.DataFrame(dict(self.columns), index=index)

    def arrow(self) -> pa.Table:
        """The samples as an Arrow table: ``time`` in microseconds, UTC, and a column for each field.

        A field that is itself called ``time`` is the column ``_time``, as in the archive. A column of several
        kinds of values is text. A field's metadata has its ``unit``, the schema's ``robot`` and ``stream``.
        """
        # A third of a second of import.
        import pyarrow as pa  # noqa: PLC0415 - see above

        from iort_analysis.archive.columns import column_name  # noqa: PLC0415 - imports pyarrow

        arrays = [pa.array(self.times_us, type=pa.timestamp("us", tz="UTC"))]
        fields = [pa.field("time", arrays[0].type, nullable=False)]
        for name, column in self.columns.items():
            try:
                array = pa.array(column, from_pandas=True)
            except (pa.ArrowInvalid, pa.ArrowTypeError, OverflowError):
                # Numbers and texts, or integers beyond every type of Arrow: all as texts.
                array = pa.array([None if value is None else str(value) for value in values(column)])
            unit = self.unit(name)
            fields.append(pa.field(column_name(name), array.type, metadata={"unit": unit} if unit else None))
            arrays.append(array)
        schema = pa.schema(fields, metadata={"robot": self.robot, "stream": self.stream})
        return pa.Table.from_arrays(arrays, schema=schema)

    def polars(self) -> pl.DataFrame:
        """The samples as a Polars DataFrame, with the columns of `arrow`; their units are `unit`'s.

        Raises `StationError` without Polars, which is an extra: ``pip install 'iort-station[polars]'``.
        """
        try:
            import polars as pl  # noqa: PLC0415 - an extra
        except ImportError as error:
            raise StationError("polars is not installed: pip install 'iort-station[polars]'") from error
        # What is made of a table is a frame.
        return cast("pl.DataFrame", pl.from_arrow(self.arrow()))


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
    source: Source = AUTO,
    scan: bool = False,
    progress: PageProgress | None = None,
    most: int | None = None,
) -> Result:
    """The samples of a robot's stream from ``start`` (inclusive) to ``end`` (exclusive).

    Times are microseconds since the epoch, datetimes, or texts such as ``-10m`` and ISO 8601; None is the
    beginning or the end of the stored samples. ``fields`` and ``where``, a condition in the language of
    `iort_contract.expression`, may name the derived fields ``speed_mps`` and ``power_w``. ``every`` (such as
    ``"1s"``) averages samples, see `iort_analysis.samples.blocks.resample`. ``summary`` reads the seconds
    that Lambda 2 has written; a field then stands for its ``_min``, ``_mean``, ``_max`` and ``_last``.
    ``on="lambda"`` selects the samples in the cloud. ``source`` is "table" or "archive" to read only there.
    ``scan`` reads by Scan instead of Query.

    Raises `StationError` for an unknown robot, stream or field, naming the known ones; for an invalid time or
    condition; and for more values than ``most``.
    """
    selection = select(robot, stream, start, end, fields=fields, where=where)
    every_us = duration_us(every) if every is not None else None
    recorded, absent = Recorded(cloud, robot, stream, source=source), Counter[str]()
    if on == LAMBDA:
        if summary:
            raise StationError("the query function reads samples; query the summary without --on lambda")
        check_in_table(selection, recorded)
        blocks = by_function(cloud, selection, recorded.refused, absent, scan=scan, progress=progress)
    elif summary:
        blocks = seconds(cloud, selection, recorded, scan=scan, progress=progress)
    else:
        blocks = samples(cloud, selection, recorded, absent=absent, scan=scan, progress=progress)
    ros2, taken = False, 0

    def watched() -> Iterator[Block]:
        nonlocal ros2, taken
        read = 0
        for block in blocks:
            taken += len(block.times_us)
            read += len(block.times_us) * len(block.columns)
            if most is not None and read > most:
                raise StationError(
                    f"the range has more than {most:,} values: choose a shorter one, or run `iort query`"
                )
            ros2 = ros2 or has_fraction(block)
            yield block

    block = join(list(watched())) if every_us is None else resample(watched(), every_us)
    if summary and fields is None:
        block = in_column_order(block)
    if not len(block.times_us) and not recorded.refused.count:
        inventory.check_there(cloud, robot, stream)
    return Result(
        robot,
        stream,
        block.times_us,
        block.columns,
        recorded.refused.count,
        recorded.refused.reason,
        ros2,
        absent,
        recorded.origin.within(selection.start_us, selection.end_us),
        taken,
        cache(partial(inventory.kind_of, cloud, selection)),
    )


def samples(
    cloud: Cloud,
    selection: Selection,
    recorded: Recorded | None = None,
    *,
    absent: Counter[str] | None = None,
    messages: bool = True,
    scan: bool = False,
    progress: PageProgress | None = None,
) -> Generator[Block, None, None]:
    """The selection's samples block by block, for ranges that do not fit in memory.

    ``absent`` counts values by field that became null because their sensor is not fitted; without it they
    stay as recorded. Without ``messages``, samples of ROS messages are skipped; ``scan`` reads by Scan.
    Raises `StationError` at the end for a named field that no sample has.
    """
    recorded = recorded or Recorded(cloud, selection.robot, selection.stream)
    keys = with_samples_between(selection.start_us, selection.end_us)
    parts = recorded.parts(keys, selection.wanted(), messages=messages, scan=scan, progress=progress)
    named = selection.named()
    derived = named & DERIVED.keys()
    vehicle = registry.vehicle_of(cloud, selection.robot) if derived else None
    there: set[str] = set()
    some = False
    for whole in in_order(parts):
        block = _within(whole, selection)
        block = block if absent is None else _without_absent(block, absent)
        n = len(block.times_us)
        some = some or n > 0
        columns = dict(block.columns)
        if derived:
            columns |= {name: made for name, made in derive(columns, vehicle).items() if name in derived}
        there |= columns.keys()
        names = block.columns if selection.fields is None else selection.fields
        null = np.full(n, np.nan)
        chosen = Block(block.times_us, {name: columns.get(name, null) for name in names})
        if selection.condition is not None:
            chosen = chosen.take(holds(selection.condition, columns, n))
        if len(chosen.times_us):
            yield chosen
    if some and not named <= there:
        raise inventory.unknown_fields(cloud, selection, there)


def has_fraction(block: Block) -> bool:
    """Whether charge or energy has fractions, which only the ROS 2 driver sends; the ROS 1 driver counts."""
    return any(
        column.dtype.kind == "f" and bool((column > np.floor(column)).any())
        for name, column in block.columns.items()
        if name.startswith(_BY_DRIVER) and not name.endswith(_MEAN)
    )


def _within(block: Block, selection: Selection) -> Block:
    """The block's samples in the selection's range."""
    times = block.times_us
    first = 0 if selection.start_us is None else int(times.searchsorted(selection.start_us))
    last = len(times) if selection.end_us is None else int(times.searchsorted(selection.end_us))
    return block if (first, last) == (0, len(times)) else block.take(slice(first, last))


def _without_absent(block: Block, counts: Counter[str]) -> Block:
    """The block with null for values of sensors that are not fitted, which ``counts`` counts by field."""
    changed: dict[str, Column] = {}
    for name in block.columns.keys() & ABSENT_FROM.keys():
        column = block.columns[name]
        numbers = column.dtype.kind == "f"
        if numbers:
            mask = column <= ABSENT_FROM[name]
        else:
            mask = np.array([is_absent(name, value) for value in column.tolist()], dtype=np.bool_)
        if mask.any():
            changed[name] = column.copy()
            changed[name][mask] = np.nan if numbers else None
            counts[name] += int(mask.sum())
    return Block(block.times_us, {**block.columns, **changed}) if changed else block
