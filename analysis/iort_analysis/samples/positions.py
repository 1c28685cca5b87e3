"""A robot's position from the fields of its samples, in metres or in degrees."""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

# The position's fields in Pose2D, Odometry, PoseStamped and Point.
_METRES = (
    ("x", "y"),
    ("x_m", "y_m"),
    ("position.x", "position.y"),
    ("pose.position.x", "pose.position.y"),
    ("pose.pose.position.x", "pose.pose.position.y"),
    ("point.x", "point.y"),
)
# NavSatFix and geographic_msgs have latitude, VESC Tool's logs gnss_lat.
_LATITUDE = re.compile(r"((?:.*[._])?)(?:lat(itude)?)")
_DEGREES = re.compile(r"(?:.*[._])?(?:lat(itude)?|lon(gitude)?)(?:_(?:min|mean|max|last))?")
# Beside a latitude: how far off it may be, in metres.
_ACCURACIES = ("hAcc", "h_acc", "horizontal_accuracy", "accuracy")
# The mean radius of the Earth, IUGG.
_EARTH_M = 6_371_008.8

Column = NDArray[Any]


class PositionFields(NamedTuple):
    """The names of x and y in metres, or of latitude and longitude in ``degrees``."""

    names: tuple[str, str]
    degrees: bool = False


def position_fields(names: Collection[str]) -> PositionFields | None:
    """The position's fields among these names; None if there are none."""
    for pair in _METRES:
        if all(name in names for name in pair):
            return PositionFields(pair)
    for name in names:
        if match := _LATITUDE.fullmatch(name):
            longitude = f"{match[1]}lon{'gitude' if match[2] else ''}"
            if longitude in names:
                return PositionFields((name, longitude), degrees=True)
    return None


def in_degrees(name: str) -> bool:
    """Whether a field or statistic is a latitude or longitude, whose seventh decimal is 1 cm."""
    return _DEGREES.fullmatch(name) is not None


def fixes(columns: Mapping[str, Column], fields: PositionFields) -> tuple[Column, Column]:
    """Latitude and longitude; NaN without a fix, which receivers report as 0, 0 or as a negative status
    (NavSatFix)."""
    latitude, longitude = (columns[name].astype(np.float64) for name in fields.names)
    with np.errstate(invalid="ignore"):
        known = (np.abs(latitude) <= 90) & (np.abs(longitude) <= 180) & ((latitude != 0) | (longitude != 0))
        status = columns.get(f"{fields.names[0].rpartition('latitude')[0]}status.status")
        if status is not None and status.dtype.kind == "f":
            known &= ~(status < 0)
    return np.where(known, latitude, np.nan), np.where(known, longitude, np.nan)


def accuracy_m(columns: Mapping[str, Column], fields: PositionFields) -> Column | None:
    """How sure the receiver is of each position, in metres; None if it does not say.

    VESC Tool's logs have gnss_hAcc, NavSatFix has variances to the east and north.
    """
    prefix = fields.names[0].removesuffix("latitude").removesuffix("lat")
    for name in (f"{prefix}{known}" for known in _ACCURACIES):
        column = columns.get(name)
        if column is not None and column.dtype.kind == "f":
            return column
    east, north = (columns.get(f"{prefix}position_covariance.{i}") for i in (0, 4))
    kind = columns.get(f"{prefix}position_covariance_type")
    if east is None or north is None or east.dtype.kind != "f" or north.dtype.kind != "f":
        return None
    with np.errstate(invalid="ignore"):
        found = np.sqrt((east + north) / 2)
    # Type 0 says that the covariance is not known.
    return found if kind is None or kind.dtype.kind != "f" else np.where(kind > 0, found, np.nan)


def local_metres(latitude: Column, longitude: Column, origin: tuple[float, float]) -> tuple[Column, Column]:
    """Metres to the east and north of a place by equirectangular projection, to 0.1 % within about 10 km."""
    around = (longitude - origin[1] + 180) % 360 - 180
    east = np.radians(around) * _EARTH_M * np.cos(np.radians(origin[0]))
    return east, np.radians(latitude - origin[0]) * _EARTH_M
