"""A car's past for the live page: its runs, the samples of a range, and their download as a file."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from iort_analysis.samples.batches import RefusedItems
from iort_analysis.samples.blocks import Column, values
from iort_analysis.samples.positions import position_fields
from iort_contract.catalog.derived import PARAMETERS, SOURCES
from iort_contract.catalog.streams import OWN_STREAMS
from iort_contract.messages.files import ATTACHMENT_FIELDS
from iort_contract.messages.page import Column as PageColumn
from iort_contract.messages.page import FieldsAnswer, HistoryAnswer, RunsAnswer, StreamFields
from iort_contract.ros.message import MessageType
from iort_station import data
from iort_station.cloud import Cloud
from iort_station.data import Selection, bags, export, inventory, tabular
from iort_station.data.bags import Recording, Topic
from iort_station.data.conditions import derive
from iort_station.data.runs import runs
from iort_station.errors import StationError
from iort_station.page.requests import robot_of, text, whole
from iort_station.page.server import Download
from iort_station.times import iso_s

# No chart is wider, in points.
MAX_ROWS = 5_000
# Half an hour of thirty fields at 500 Hz; their table takes 240 MB of memory.
MOST_VALUES = 30_000_000
# Longer ranges are read from the summary of each second, not from samples.
_SAMPLES_US = 3_600_000_000
# The fields that a derived field needs, where it needs nothing else. The page makes the speed itself.
_DERIVED_OF = [frozenset(sources) for name, sources in SOURCES.items() if not PARAMETERS[name]]
_MOST_RUNS = 200


def runs_of(cloud: Cloud, request: Mapping[str, str]) -> RunsAnswer:
    """The ``count`` newest runs of ``robot``, or the newest ones before ``before_us``."""
    before_us = whole(request, "before_us", 0, 2**53) if "before_us" in request else None
    count = whole(request, "count", 1, _MOST_RUNS)
    robot = robot_of(request)
    # The page also asks about a car that never recorded, or that nobody knows: it has no runs.
    streams = [name for name in inventory.streams_of(cloud, robot) if name not in OWN_STREAMS]
    return runs(cloud, robot, streams=streams, end_us=before_us, count=count)


def history(cloud: Cloud, request: Mapping[str, str]) -> HistoryAnswer:
    """The samples of ``robot`` and ``stream`` from ``from_us`` to ``to_us``, in at most ``rows`` rows.

    A row of several samples has the minimum, the mean and the maximum of every number, the last position and
    the last complete attachment, and the last value that is not null of everything else. Raises
    `StationError` for a request that cannot be answered.
    """
    start_us, end_us = (whole(request, name, 0, 2**53) for name in ("from_us", "to_us"))
    rows = whole(request, "rows", 2, MAX_ROWS)
    if start_us >= end_us:
        raise StationError("the range must end after its start")
    summary = end_us - start_us > _SAMPLES_US
    robot, stream = text(request, "robot"), text(request, "stream")
    result = data.query(cloud, robot, stream, start_us, end_us, summary=summary, most=MOST_VALUES)
    columns = (
        _by_statistic(result.columns)
        if summary
        else {name: (c, c, c) for name, c in _with_derived(result.columns).items()}
    )
    claims = _claims(columns)
    n = len(result)
    row_us = 0
    starts = np.arange(n)
    if n > rows:
        row_us = -(-(int(result.times_us[-1] - result.times_us[0]) + 1) // rows)
        bins = (result.times_us - result.times_us[0]) // row_us
        starts = np.flatnonzero(np.append(True, bins[1:] != bins[:-1]))
    several = summary or row_us > 0
    rows_of: dict[str, PageColumn] = {
        name: _rows(each, starts, n, several=several) for name, each in columns.items() if name not in claims
    }
    for name, key in claims.items():
        # The fields of an attachment belong together, so they come from one sample.
        parts, ends = values(result.columns[name]), _last(_known(result.columns[key]), starts)
        rows_of[name] = {"mean": [parts[end] for end in ends]}
    numbers = [name for name, (column, *_) in columns.items() if column.dtype.kind == "f"]
    if several and n and (place := position_fields(numbers)) is not None:
        # The mean of a curve is a place where the robot never was.
        each = [columns[name][0] for name in place.names]
        ends = _last(~np.isnan(each).any(axis=0), starts)
        for name, column in zip(place.names, each, strict=True):
            rows_of[name]["mean"] = values(column[ends])
    return {
        "times_s": [t_us / 1e6 for t_us in result.times_us[starts].tolist()],
        "fields": rows_of,
        "samples": int(np.nansum(result.columns["n"])) if summary and "n" in result.columns else n,
        "ros2": result.ros2,
        "row_s": max(row_us / 1e6, 1.0 if summary else 0.0),
        "archive": result.origin.told(),
        "refused": result.refused,
        "reason": result.reason,
    }


def _with_derived(columns: Mapping[str, Column]) -> dict[str, Column]:
    """The columns and those derived of them alone, which the summary has too."""
    if not any(columns.keys() >= sources for sources in _DERIVED_OF):
        return dict(columns)
    return {**columns, **derive(columns, None)}


def _by_statistic(columns: Mapping[str, Column]) -> dict[str, tuple[Column, Column, Column]]:
    """The summary's columns for each field: mean, minimum, maximum."""
    names = [name.removesuffix("_mean") for name in columns if name.endswith("_mean")]
    return {
        name: (columns[f"{name}_mean"], columns[f"{name}_min"], columns[f"{name}_max"])
        for name in names
        if f"{name}_min" in columns and f"{name}_max" in columns
    }


def _claims(columns: Mapping[str, Any]) -> dict[str, str]:
    """The fields of attachments (docs/how-to/files.md), each with the field of its attachment's key."""
    fields = [name.removesuffix(".key") for name in columns if name.endswith(".key")]
    return {
        f"{field}.{part}": f"{field}.key"
        for field in fields
        if all(f"{field}.{part}" in columns for part in ATTACHMENT_FIELDS)
        for part in ATTACHMENT_FIELDS
    }


def _rows(of: tuple[Column, Column, Column], starts: Any, n: int, *, several: bool) -> PageColumn:
    mean, least, most = of
    if mean.dtype.kind != "f":
        return {"mean": mean[_last(_known(mean), starts)].tolist()}
    if not several or n == 0:
        return {"mean": values(mean)}
    known = ~np.isnan(mean)
    number = np.add.reduceat(known.astype(float), starts)
    number[number == 0] = np.nan
    with np.errstate(invalid="ignore", over="ignore"):
        average = np.add.reduceat(np.where(known, mean, 0.0), starts) / number
    return {
        "mean": values(average),
        "least": values(np.fmin.reduceat(least, starts)),
        "most": values(np.fmax.reduceat(most, starts)),
    }


def _known(column: Column) -> Any:
    return np.array([value is not None for value in column.tolist()], dtype=bool)


def _last(known: Any, starts: Any) -> Any:
    """For each row the index of its last sample that is known, or of its last sample if none is.

    Most attachments of a camera are null, because the car keeps few of its pictures.
    """
    n = len(known)
    if not n:
        return starts
    last = np.maximum.reduceat(np.where(known, np.arange(n), -1), starts)
    return np.where(last >= starts, last, np.append(starts[1:], n) - 1)


def fields(cloud: Cloud, request: Mapping[str, str]) -> FieldsAnswer:
    """The fields of each stream of ``robot``, by its newest batch."""
    robot = robot_of(request)
    return {"streams": {name: _fields(cloud, robot, name) for name in inventory.streams_of(cloud, robot)}}


def _fields(cloud: Cloud, robot: str, stream: str) -> StreamFields:
    columns = _with_derived(inventory.newest_block(cloud, robot, stream).columns)
    numbers = sorted(name for name, column in columns.items() if column.dtype.kind == "f")
    place = position_fields(numbers)
    return {
        "numbers": numbers,
        "position": [] if place is None else list(place.names),
        "degrees": place is not None and place.degrees,
    }


MOST_BYTES = 1_000_000_000


def downloads(cloud: Cloud) -> dict[str, Download]:
    """Every download, by the name that is requested: the samples of ``robot`` and ``stream`` from ``from_us``
    to ``to_us``, as recorded."""
    return {
        "history.csv": partial(_table, cloud, ".csv"),
        "history.parquet": partial(_table, cloud, ".parquet"),
        "history.mcap": partial(_mcap, cloud),
    }


def _table(cloud: Cloud, suffix: str, request: Mapping[str, str], folder: Path) -> Path:
    chosen = _selection(request)
    result = data.query(cloud, chosen.robot, chosen.stream, chosen.start_us, chosen.end_us, most=MOST_VALUES)
    if not len(result):
        raise StationError("no samples in this range")
    path = folder / _name(chosen, suffix, result.refused)
    if suffix == ".csv":
        with path.open("w", encoding="utf-8", newline="") as file:
            tabular.to_csv(result, file)
    else:
        with path.open("wb") as binary:
            tabular.to_parquet(result, binary)
    return path


def _mcap(cloud: Cloud, request: Mapping[str, str], folder: Path) -> Path:
    selection = _selection(request)
    path, refused = folder / "export.mcap", RefusedItems()
    with bags.mcap(path) as file:
        if not export.write(cloud, selection, _Bounded(file), refused=refused):
            raise StationError("no samples in this range")
    return path.rename(folder / _name(selection, ".mcap", refused.count))


class _Bounded:
    """A recording that refuses more than `MOST_BYTES`."""

    def __init__(self, file: Recording) -> None:
        self._file, self._left = file, MOST_BYTES

    def topic(self, kind: MessageType) -> Topic:
        topic = self._file.topic(kind)

        def bounded(t_ns: int, message: bytes) -> None:
            self._left -= len(message)
            if self._left < 0:
                raise StationError(
                    f"the range has over {MOST_BYTES:,} bytes: choose a shorter one, or run `iort export`"
                )
            topic.write(t_ns, message)

        return topic._replace(write=bounded)


def _selection(request: Mapping[str, str]) -> Selection:
    start_us, end_us = (whole(request, name, 0, 2**53) for name in ("from_us", "to_us"))
    return data.select(text(request, "robot"), text(request, "stream"), start_us, end_us)


def _name(selection: Selection, suffix: str, refused: int) -> str:
    """car7-vesc-20260504T100000Z.csv, or ...Z-2-left-out.csv, which says so wherever it goes.

    Every file system takes these names.
    """
    start = iso_s(selection.start_us or 0).replace("-", "").replace(":", "")
    left_out = f"-{refused}-left-out" if refused else ""
    return f"{selection.robot}-{selection.stream}-{start}{left_out}{suffix}"
