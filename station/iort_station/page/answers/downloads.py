"""The page's downloads: the samples of a range as a file that other tools open.

Each writes a file into a folder and returns it, so that an error is known before anything is sent.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path

from iort_analysis.samples.batches import RefusedItems
from iort_station import data
from iort_station.cloud import Cloud
from iort_station.data import Result, Selection
from iort_station.errors import StationError
from iort_station.page.answers.history import MOST_VALUES
from iort_station.page.answers.parameters import text, whole
from iort_station.page.server import Download
from iort_station.recordings import export, recordings, tabular
from iort_station.recordings.recordings import Recording, Write
from iort_station.times import iso_s

MOST_BYTES = 1_000_000_000


def downloads(cloud: Cloud) -> dict[str, Download]:
    """Every download, by the name that is requested: the samples of ``robot`` and ``stream`` from ``from_us``
    to ``to_us``, as recorded."""
    return {
        "history.csv": partial(_table, cloud, _csv, ".csv"),
        "history.parquet": partial(_table, cloud, _parquet, ".parquet"),
        "history.mcap": partial(_mcap, cloud),
    }


def _table(
    cloud: Cloud, write: Callable[[Result, Path], None], suffix: str, asked: Mapping[str, str], folder: Path
) -> Path:
    selection = _selection(asked)
    found = data.query(
        cloud,
        selection.robot,
        selection.stream,
        selection.start_us,
        selection.end_us,
        most=MOST_VALUES,
    )
    if not len(found):
        raise StationError("no samples in this range")
    path = folder / _name(selection, suffix, found.refused)
    write(found, path)
    return path


def _csv(found: Result, path: Path) -> None:
    with path.open("w", encoding="utf-8", newline="") as file:
        tabular.to_csv(found, file)


def _parquet(found: Result, path: Path) -> None:
    with path.open("wb") as file:
        tabular.to_parquet(found, file)


def _mcap(cloud: Cloud, asked: Mapping[str, str], folder: Path) -> Path:
    selection = _selection(asked)
    path, refused = folder / "export.mcap", RefusedItems()
    with recordings.mcap(path) as file:
        if not export.write(cloud, selection, _Bounded(file), refused=refused):
            raise StationError("no samples in this range")
    return path.rename(folder / _name(selection, ".mcap", refused.count))


class _Bounded:
    """A recording that refuses more than `MOST_BYTES`."""

    def __init__(self, file: Recording) -> None:
        self._file, self._left = file, MOST_BYTES
        self.ros2 = file.ros2

    def topic(self, topic: str, kind: str, definition: str, md5sum: str, *, ros2: bool = False) -> Write:
        write = self._file.topic(topic, kind, definition, md5sum, ros2=ros2)

        def bounded(t_ns: int, message: bytes) -> None:
            self._left -= len(message)
            if self._left < 0:
                raise StationError(
                    f"the range has over {MOST_BYTES:,} bytes: choose a shorter one, or run `iort export`"
                )
            write(t_ns, message)

        return bounded


def _selection(asked: Mapping[str, str]) -> Selection:
    start_us, end_us = (whole(asked, name, 0, 2**53) for name in ("from_us", "to_us"))
    return data.select(text(asked, "robot"), text(asked, "stream"), start_us, end_us)


def _name(selection: Selection, suffix: str, refused: int) -> str:
    """car7-vesc-20260504T100000Z.csv, or ...Z-2-left-out.csv, which says so wherever it goes.

    Every file system takes these names.
    """
    start = iso_s(selection.start_us or 0).replace("-", "").replace(":", "")
    left_out = f"-{refused}-left-out" if refused else ""
    return f"{selection.robot}-{selection.stream}-{start}{left_out}{suffix}"
