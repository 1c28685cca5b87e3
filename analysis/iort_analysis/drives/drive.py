"""A drive as the miners see it: clean samples of all streams on one clock, and what tells its motion."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from iort_analysis import NoResultError
from iort_analysis.samples.blocks import Block, Column
from iort_contract.catalog.derived import Vehicle
from iort_contract.catalog.streams import CATALOG
from iort_contract.catalog.vesc import VESC, VESC_STREAM
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

    def motor(self, *names: str, reason: str = "") -> list[Column]:
        """Fields of the motor controller; raises `NoResultError` with the reason if one is not there."""
        columns = [self.of(self.vesc, name) for name in names]
        if any(column is None for column in columns):
            raise NoResultError(reason or f"needs {' and '.join(names)}")
        return [column for column in columns if column is not None]

    def mps(self, erpm: Column) -> Column:
        """The car's speed by its motor's, if the vehicle is known."""
        if self.vehicle is None:
            raise NoResultError("needs the car's parameters")
        speed: Column = (erpm - self.vehicle.speed_to_erpm_offset) / self.vehicle.speed_to_erpm_gain
        return speed


# Which fields tell that a car moves, and which streams are a motor controller's or a position's.

# The last parts of fields that have a speed. The first one that a robot has counts: odometries and receivers
# measure it, and a speed or a twist may be a command.
_SPEEDS = (
    "twist.twist.linear.x",
    "speed_meters_per_sec",
    "speed_mps",
    "gnss_gVel",
    "velocity",
    "twist.linear.x",
    "speed",
    "linear.x",
)
# The absolute value above which a car moves, by the unit: a few centimetres a second.
_LEAST = {"erpm": 200.0, "m/s": 0.05}
# ROS has speeds in SI units (REP 103).
_USUAL = "m/s"
_VESC = frozenset({"speed", "voltage_input", "current_motor"})
# Where the usual messages have a position and a direction: an odometry, a stamped pose, a pose.
_PLACES = ("pose.pose.", "pose.", "")


def is_vesc(stream: str, names: Collection[str]) -> bool:
    """Whether a stream's fields are a motor controller's: by its name in the catalogue, or by its fields."""
    return stream == VESC_STREAM or frozenset(names) >= _VESC


class Motion(NamedTuple):
    """The field of a stream that tells whether the car moves, and its unit."""

    stream: str
    field: str
    unit: str

    @property
    def least(self) -> float:
        """The absolute value above which the car moves, in the unit."""
        return _LEAST[self.unit]

    def moves(self, columns: Mapping[str, Column]) -> NDArray[np.bool_] | None:
        """Whether the car moves, for every sample of the stream; None if the field has no numbers."""
        column = columns.get(self.field)
        if column is None or column.dtype.kind != "f":
            return None
        with np.errstate(invalid="ignore"):
            return np.abs(column) > self.least


def motion_of(stream: str, names: Collection[str]) -> Motion | None:
    """What tells of motion in a stream with these fields; None if nothing does."""
    if is_vesc(stream, names) and "speed" in names:
        return Motion(stream, "speed", VESC.unit("speed"))
    for speed in _SPEEDS:
        for name in sorted(names):
            if name == speed or name.endswith(f".{speed}"):
                unit = CATALOG[stream].unit(name) if stream in CATALOG else ""
                return Motion(stream, name, unit if unit in _LEAST else _USUAL)
    return None


def moving(stream: str, columns: Mapping[str, Column]) -> NDArray[np.bool_] | None:
    """Whether the car moves, for every sample of a stream; None if no field tells."""
    motion = motion_of(stream, [name for name, column in columns.items() if column.dtype.kind == "f"])
    return None if motion is None else motion.moves(columns)


def vescs_of(streams: Mapping[str, Collection[str]]) -> list[str]:
    """The streams with a motor controller's fields, by name."""
    return sorted(name for name, fields in streams.items() if frozenset(fields) >= _VESC)


def vesc_of(streams: Mapping[str, Collection[str]]) -> str | None:
    """The stream of the motor controller that is analysed: the first one by name if there are several."""
    return next(iter(vescs_of(streams)), None)


def motion_among(streams: Mapping[str, Collection[str]]) -> Motion | None:
    """What tells of a robot's motion: its motor controller's speed, or else the best field that it has."""
    told = [motion for name, fields in sorted(streams.items()) if (motion := motion_of(name, fields))]
    return min(told, key=lambda one: _rank(one, vesc_of(streams)), default=None)


def _rank(motion: Motion, vesc: str | None) -> tuple[bool, int]:
    places = (i for i, speed in enumerate(_SPEEDS) if f".{motion.field}".endswith(f".{speed}"))
    return motion.stream != vesc, next(places)


def pose_of(streams: Mapping[str, Block]) -> str | None:
    """The stream with a position, after `with_position`."""
    named = [name for name, block in streams.items() if {"x", "y"} <= block.columns.keys()]
    with_heading = [name for name in named if "heading" in streams[name].columns]
    return min(with_heading or named, default=None)


def with_position(block: Block) -> Block:
    """The block with ``x`` and ``y`` in metres and ``heading`` in radians, where a pose or an odometry has
    them under longer names."""
    columns = block.columns
    for prefix in _PLACES:
        x, y = f"{prefix}position.x", f"{prefix}position.y"
        if "x" in columns or not {x, y} <= columns.keys():
            continue
        added = {"x": columns[x], "y": columns[y]}
        turn = [columns.get(f"{prefix}orientation.{axis}") for axis in "xyzw"]
        if all(part is not None and part.dtype.kind == "f" for part in turn):
            qx, qy, qz, qw = (part for part in turn if part is not None)
            added["heading"] = np.arctan2(2 * (qw * qz + qx * qy), 1 - 2 * (qy * qy + qz * qz))
        return Block(block.times_us, {**columns, **added})
    return block
