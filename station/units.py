"""Units of fields, by the driver that their values came from."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import numpy as np

from contract import (
    AGENT_FIELDS,
    AGENT_STREAM,
    DERIVED_UNITS,
    RTT_FIELDS,
    RTT_STREAM,
    STATS,
    VESC_FIELDS,
    VESC_STREAM,
)
from station.blocks import Block

# REP 103, "Units", of what geometry_msgs, nav_msgs and sensor_msgs call by names of their own: the unit of
# the fields x, y and z within.
ROS_UNITS = {
    "linear_acceleration": "m/s^2",
    "angular_velocity": "rad/s",
    "twist.linear": "m/s",
    "twist.angular": "rad/s",
    "position": "m",
    "translation": "m",
}
_MEAN = f"_{STATS[1]}"
_BY_DRIVER = tuple(field.name for field in VESC_FIELDS.values() if field.ros2_unit is not None)


class Driver:
    """Tells by samples that pass whose units they have: a count of 1e-4 Ah is whole, what the ROS 2
    driver made of it is not."""

    def __init__(self) -> None:
        self.ros2 = False

    def told(self, found: Iterable[Block]) -> Iterator[Block]:
        """The same blocks: samples, or the summary's seconds."""
        for block in found:
            self.ros2 = self.ros2 or any(
                column.dtype.kind == "f" and bool((column > np.floor(column)).any())
                for name, column in block.columns.items()
                if name.startswith(_BY_DRIVER) and not name.endswith(_MEAN)
            )
            yield block


def unit(stream: str, name: str, *, ros2: bool = False) -> str:
    """The unit of a field, or of a statistic of it; empty where none is known. ``ros2`` for the ROS 2
    driver's samples."""
    stem, _, statistic = name.rpartition("_")
    for field in (name, stem) if statistic in STATS else (name,):
        if field in DERIVED_UNITS:
            return DERIVED_UNITS[field]
        if stream == VESC_STREAM and field in VESC_FIELDS:
            known = VESC_FIELDS[field]
            return (known.ros2_unit if ros2 else None) or known.unit
        if stream == RTT_STREAM and field in RTT_FIELDS.values():
            return "ms"
        if stream == AGENT_STREAM and field in AGENT_FIELDS:
            return agent_unit(field)
        within, _, axis = field.rpartition(".")
        if axis in {"x", "y", "z"}:
            known_as = (of for of in ROS_UNITS if within == of or within.endswith(f".{of}"))
            return next((ROS_UNITS[of] for of in known_as), "")
    return ""


def agent_unit(field: str) -> str:
    """The unit of one of the agent's own figures."""
    return AGENT_FIELDS[field].split()[0].rstrip(",")
