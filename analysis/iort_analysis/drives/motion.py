"""Which fields tell that a car moves, and which streams are a motor controller's or a position's."""

from __future__ import annotations

from collections.abc import Collection, Mapping

import numpy as np
from numpy.typing import NDArray

from iort_analysis.samples.blocks import Block, Column

# A field of speed, and the absolute value above which the car moves: a few centimetres a second. The first
# one that a stream has counts.
MOTION = {
    "speed": 200.0,  # erpm
    "speed_meters_per_sec": 0.05,
    "twist.twist.linear.x": 0.05,
    "linear.x": 0.05,
}
_VESC = frozenset({"speed", "voltage_input", "current_motor"})
# Where the usual messages have a position and a direction: an odometry, a stamped pose, a pose.
_PLACES = ("pose.pose.", "pose.", "")


def motion_field(names: Collection[str]) -> str | None:
    """The field that tells whether the car moves; None if there is none."""
    return next((name for name in MOTION if name in names), None)


def moving(columns: Mapping[str, Column]) -> NDArray[np.bool_] | None:
    """Whether the car moves, for every sample; None if no field tells."""
    name = motion_field([name for name, column in columns.items() if column.dtype.kind == "f"])
    if name is None:
        return None
    with np.errstate(invalid="ignore"):
        return np.abs(columns[name]) > MOTION[name]


def vescs_of(streams: Mapping[str, Collection[str]]) -> list[str]:
    """The streams with a motor controller's fields, by name."""
    return sorted(name for name, fields in streams.items() if frozenset(fields) >= _VESC)


def vesc_of(streams: Mapping[str, Collection[str]]) -> str | None:
    """The stream of the motor controller that is analysed: the first one by name if there are several."""
    return next(iter(vescs_of(streams)), None)


def motion_stream(streams: Mapping[str, Collection[str]]) -> str | None:
    """The stream that tells whether the car moves: the motor controller's, or the first one with a speed."""
    with_speed = (name for name, fields in streams.items() if motion_field(fields) is not None)
    return vesc_of(streams) or min(with_speed, default=None)


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
