"""Writes a LeRobot dataset, version 3.0: https://huggingface.co/docs/lerobot/lerobot-dataset-v3.

    meta/info.json, stats.json, tasks.parquet     features, statistics, the task's text
    meta/episodes/chunk-000/file-000.parquet      an episode a row: its frames, files and statistics
    data/chunk-CCC/file-FFF.parquet               an episode's frames
    videos/<camera>/chunk-CCC/file-FFF.mp4        an episode's images
    meta/iort.json                                an episode's robot, time and source; fields with their units

Each episode has files of its own, so that the memory for any number of them is that of one.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from iort_station.data.episodes import Episode, Field, Frames, Shape, Source, episodes, from_images
from iort_station.data.images import Pixels, resized
from iort_station.errors import StationError
from iort_station.output import whole_folder

VERSION = "v3.0"
_FILES_A_CHUNK = 1000
_STATE, _ACTION = "observation.state", "action"
# A file that no other program's dataset has.
_OURS = "meta/iort.json"
_QUANTILES = (0.01, 0.10, 0.50, 0.90, 0.99)
# H.264 plays everywhere; every second frame is a whole one, so that a frame is found fast, as LeRobot has it.
_CODEC, _OPTIONS = "libx264", {"crf": "23", "g": "2", "preset": "veryfast"}
# What its encoder takes.
_LEAST_SIDE, _MOST_SIDE = 16, 16_384
_SCALARS = {
    "timestamp": "float32",
    "frame_index": "int64",
    "episode_index": "int64",
    "index": "int64",
    "task_index": "int64",
}
# Where an image's brightness lies in all frames: 256 counts a channel.
_Histogram = NDArray[np.int64]


@dataclass
class Written:
    """What was written. ``not_kept`` are images whose content the robot has not kept, ``damaged`` those that
    cannot be shown, ``resized`` those of another size than their camera's first. ``left_out`` counts sources
    that could not be read or lack a field or a camera; ``reason`` says why of the first."""

    episodes: int = 0
    frames: int = 0
    not_kept: int = 0
    damaged: int = 0
    resized: int = 0
    left_out: int = 0
    reason: str = ""


def write(
    out: Path,
    sources: Iterable[Source | StationError],
    shape: Shape,
    *,
    task: str,
    robot: str,
    units: Mapping[Field, str],
    force: bool = False,
    progress: Callable[[int, int], None] = lambda _frames, _last_us: None,
) -> Written:
    """Write the episodes of sources as a dataset, which appears once it is whole.

    ``task`` says in words what the robot did. A source that lacks a field or a camera is left out, and
    counted, and so is an error in its place. Raises `StationError` if there is no episode, if ``out`` exists
    and is no dataset that was written here, or exists without ``force``; and for images of another type.
    """
    if shape.cameras:
        _av()
    with whole_folder(out, _OURS, "dataset of `iort export`", force=force) as folder:
        dataset = _Dataset(folder, shape, task, robot, units)
        for source in sources:
            try:
                if isinstance(source, StationError):
                    raise source
                parts = episodes(source, shape)
                frames = {camera: Frames(source, camera) for camera in shape.cameras}
                # All fields are read before the first episode.
                first = next(parts, None)
            except StationError as error:
                dataset.written.left_out += 1
                dataset.written.reason = dataset.written.reason or str(error)
                continue
            for part in () if first is None else chain((first,), parts):
                episode = from_images(part, frames.values(), shape.fps)
                if episode is not None:
                    dataset.add(episode, frames, source.about)
                progress(len(part.times_us), int(part.times_us[-1]))
            dataset.written.damaged += sum(each.damaged for each in frames.values())
            dataset.written.not_kept += sum(each.not_kept for each in frames.values())
        if not dataset.written.episodes:
            if dataset.written.reason:
                raise StationError(f"{dataset.written.reason}; {out} is not written")
            wanted = ", ".join(map(str, shape.fields))
            images = f" and an image of {', '.join(shape.cameras)} that can be shown" if shape.cameras else ""
            raise StationError(f"no second has all of {wanted}{images}; {out} is not written")
        dataset.finish()
    return dataset.written


class _Dataset:
    def __init__(self, folder: Path, shape: Shape, task: str, robot: str, units: Mapping[Field, str]) -> None:
        self._folder, self._shape, self._task, self._robot, self._units = folder, shape, task, robot, units
        self.written = Written()
        self._rows: list[dict[str, Any]] = []
        self._about: list[Mapping[str, Any]] = []
        self._statistics: dict[str, list[dict[str, list[float]]]] = {}
        self._videos: dict[str, _Camera] = {f"observation.images.{name}": _Camera() for name in shape.cameras}

    def add(self, episode: Episode, frames: Mapping[str, Frames], about: Mapping[str, Any]) -> None:
        """Write an episode."""
        number, n = self.written.episodes, len(episode.times_us)
        columns: dict[str, NDArray[Any]] = {
            _STATE: _vectors(episode, self._shape.state),
            _ACTION: _vectors(episode, self._shape.action),
            "timestamp": (np.arange(n) / self._shape.fps).astype(np.float32),
            "frame_index": np.arange(n),
            "episode_index": np.full(n, number),
            "index": np.arange(self.written.frames, self.written.frames + n),
            "task_index": np.zeros(n, dtype=np.int64),
        }
        place = dict(zip(("chunk_index", "file_index"), divmod(number, _FILES_A_CHUNK), strict=True))
        row: dict[str, Any] = {
            "episode_index": number,
            "tasks": [self._task],
            "length": n,
            "dataset_from_index": self.written.frames,
            "dataset_to_index": self.written.frames + n,
            "meta/episodes/chunk_index": 0,
            "meta/episodes/file_index": 0,
            **{f"data/{name}": value for name, value in place.items()},
        }
        path = self._path(f"data/{_file(place)}.parquet")
        pq.write_table(pa.table({name: _arrow(column) for name, column in columns.items()}), path)
        statistics = {name: _statistics(column) for name, column in columns.items()}
        for (key, camera), images in zip(self._videos.items(), frames.values(), strict=True):
            histogram = camera.encode(
                self._path(f"videos/{key}/{_file(place)}.mp4"),
                map(images.at, episode.times_us.tolist()),
                self._shape.fps,
            )
            statistics[key] = _of_histogram(histogram, n)
            row |= {f"videos/{key}/{name}": value for name, value in place.items()}
            row |= {f"videos/{key}/from_timestamp": 0.0, f"videos/{key}/to_timestamp": n / self._shape.fps}
        for name, each in statistics.items():
            row |= {f"stats/{name}/{statistic}": value for statistic, value in each.items()}
        for name in columns:
            self._statistics.setdefault(name, []).append(statistics[name])
        self._rows.append(row)
        first, last = int(episode.times_us[0]), int(episode.times_us[-1])
        self._about.append({"episode_index": number, "from_us": first, "to_us": last, **about})
        self.written.episodes += 1
        self.written.frames += n

    def finish(self) -> None:
        """Write what describes all episodes."""
        # pandas names the column of the texts, which LeRobot reads as the table's index.
        import pandas as pd  # noqa: PLC0415 - takes half a second

        tasks = self._path("meta/tasks.parquet")
        pd.DataFrame({"task_index": [0]}, index=pd.Index([self._task])).to_parquet(tasks)
        pq.write_table(
            pa.Table.from_pylist(self._rows), self._path("meta/episodes/chunk-000/file-000.parquet")
        )
        statistics: dict[str, Any] = {name: _joined(parts) for name, parts in self._statistics.items()}
        for key, camera in self._videos.items():
            statistics[key] = _of_histogram(camera.histogram, self.written.frames)
            self.written.resized += camera.resized
        self._json("meta/stats.json", statistics)
        count = self.written.episodes
        self._json(
            "meta/info.json",
            {
                "codebase_version": VERSION,
                "robot_type": self._robot,
                "total_episodes": count,
                "total_frames": self.written.frames,
                "total_tasks": 1,
                "chunks_size": _FILES_A_CHUNK,
                "data_files_size_in_mb": 100,
                "video_files_size_in_mb": 200,
                "fps": self._shape.fps,
                "splits": {"train": f"0:{count}"},
                "data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
                "video_path": "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"
                if self._videos
                else None,
                "features": self._features(),
            },
        )
        units = {str(name): self._units.get(name, "") for name in self._shape.fields}
        self._json(_OURS, {"units": units, "episodes": self._about})

    def _features(self) -> dict[str, Any]:
        named = {_STATE: self._shape.state, _ACTION: self._shape.action}
        features: dict[str, Any] = {
            name: {"dtype": "float32", "shape": [len(of)], "names": list(map(str, of))}
            for name, of in named.items()
        }
        features |= {key: camera.feature(self._shape.fps) for key, camera in self._videos.items()}
        return features | {
            name: {"dtype": dtype, "shape": [1], "names": None} for name, dtype in _SCALARS.items()
        }

    def _path(self, name: str) -> Path:
        path = self._folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        return path

    def _json(self, name: str, content: Mapping[str, Any]) -> None:
        self._path(name).write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")


@dataclass
class _Camera:
    """A camera's videos, all of the size of its first image, with even sides as H.264 wants them."""

    size: tuple[int, int] | None = None
    resized: int = 0
    histogram: _Histogram = field(default_factory=lambda: np.zeros((3, 256), dtype=np.int64))

    def encode(self, path: Path, images: Iterator[Pixels | None], fps: int) -> _Histogram:
        """Write an image a step, the first of which is one, and return where their brightness lies."""
        first = next(images)
        assert first is not None  # an episode begins with an image
        if self.size is None:
            height, width = (min(max(side // 2 * 2, _LEAST_SIDE), _MOST_SIDE) for side in first.shape[:2])
            self.size = width, height
        counts = np.zeros((3, 256), dtype=np.int64)
        with _av().open(str(path), "w") as container:
            stream = container.add_stream(_CODEC, rate=fps, options=_OPTIONS)
            stream.width, stream.height = self.size
            stream.pix_fmt = "yuv420p"
            before: Pixels | None = None
            for pixels in chain((first,), images):
                assert pixels is not None  # after an image there is always one
                if pixels is not before:
                    before, shown = pixels, self._fitted(pixels)
                    shown_counts = np.stack(
                        [np.bincount(shown[..., i].ravel(), minlength=256) for i in range(3)]
                    )
                counts += shown_counts
                container.mux(stream.encode(_av().VideoFrame.from_ndarray(shown, format="rgb24")))
            container.mux(stream.encode(None))
        self.histogram += counts
        return counts

    def _fitted(self, pixels: Pixels) -> Pixels:
        assert self.size is not None
        width, height = self.size
        if (pixels.shape[1] // 2 * 2, pixels.shape[0] // 2 * 2) == self.size:
            return np.ascontiguousarray(pixels[:height, :width])
        self.resized += 1
        return resized(pixels, width, height)

    def feature(self, fps: int) -> dict[str, Any]:
        """The entry of the camera in ``info.json``."""
        width, height = self.size or (0, 0)
        info = {
            "video.height": height,
            "video.width": width,
            "video.codec": "h264",
            "video.pix_fmt": "yuv420p",
            "video.is_depth_map": False,
            "video.fps": fps,
            "video.channels": 3,
            "has_audio": False,
        }
        names = ["height", "width", "channels"]
        return {"dtype": "video", "shape": [height, width, 3], "names": names, "info": info}


def _vectors(episode: Episode, fields: Sequence[Field]) -> NDArray[np.float32]:
    return np.stack([episode.columns[name] for name in fields], axis=1)


def _file(place: Mapping[str, int]) -> str:
    return f"chunk-{place['chunk_index']:03d}/file-{place['file_index']:03d}"


def _arrow(column: NDArray[Any]) -> pa.Array:
    """A column; LeRobot has vectors of one number as numbers."""
    if column.ndim == 1 or column.shape[1] == 1:
        return pa.array(column.ravel())
    return pa.FixedSizeListArray.from_arrays(pa.array(column.ravel()), column.shape[1])


def _statistics(column: NDArray[Any]) -> dict[str, list[float]]:
    """As LeRobot's `compute_stats`: of each number of a vector over all frames."""
    rows = column.reshape(len(column), -1).astype(np.float64)
    quantiles = np.quantile(rows, _QUANTILES, axis=0)
    return {
        "min": rows.min(axis=0).tolist(),
        "max": rows.max(axis=0).tolist(),
        "mean": rows.mean(axis=0).tolist(),
        "std": rows.std(axis=0).tolist(),
        "count": [len(rows)],
        **{f"q{round(q * 100):02d}": of.tolist() for q, of in zip(_QUANTILES, quantiles, strict=True)},
    }


def _joined(parts: Sequence[Mapping[str, list[float]]]) -> dict[str, list[float]]:
    """The statistics of several episodes as one, as LeRobot's `aggregate_stats` joins them: quantiles are
    their means over the frames."""
    of = {name: np.array([part[name] for part in parts], dtype=np.float64) for name in parts[0]}
    counts = of.pop("count")
    mean = (of["mean"] * counts).sum(axis=0) / counts.sum()
    spread = of["std"] ** 2 + (of["mean"] - mean) ** 2
    return {
        **{name: ((each * counts).sum(axis=0) / counts.sum()).tolist() for name, each in of.items()},
        "min": of["min"].min(axis=0).tolist(),
        "max": of["max"].max(axis=0).tolist(),
        "std": np.sqrt((spread * counts).sum(axis=0) / counts.sum()).tolist(),
        "count": [int(counts.sum())],
    }


def _of_histogram(counts: _Histogram, frames: int) -> dict[str, Any]:
    """The same of images, of each channel from 0 to 1."""
    levels = np.arange(256) / 255
    total = counts.sum(axis=1)
    mean = (counts * levels).sum(axis=1) / total
    std = np.sqrt((counts * (levels - mean[:, None]) ** 2).sum(axis=1) / total)
    there = [np.flatnonzero(channel) for channel in counts]
    ranks = np.cumsum(counts, axis=1)
    made = {
        "min": [levels[of[0]] for of in there],
        "max": [levels[of[-1]] for of in there],
        "mean": mean,
        "std": std,
        **{
            f"q{round(q * 100):02d}": [levels[np.searchsorted(of, q * of[-1])] for of in ranks]
            for q in _QUANTILES
        },
    }
    # LeRobot broadcasts them over height and width.
    shaped = {name: [[[float(value)]] for value in values] for name, values in made.items()}
    return {**shaped, "count": [frames]}


def _av() -> Any:
    """PyAV, which encodes videos; raises `StationError` if it is not installed."""
    try:
        import av  # noqa: PLC0415 - an extra
    except ImportError as error:
        raise StationError('videos need PyAV: pip install "iort-station[lerobot]"') from error
    return av
