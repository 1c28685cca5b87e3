"""Units of fields, by the type of their messages and by the driver that sent them."""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache

from iort_contract.limits import MessageError
from iort_contract.messages.message_type import MessageType
from iort_contract.ros1.definition import Fields, parse
from iort_contract.tables import STATS
from iort_contract.topics import AGENT_STREAM, RTT_FIELDS, RTT_STREAM
from iort_contract.vesc import AGENT_FIELDS, DERIVED_UNITS, VESC_FIELDS, VESC_STREAM

VESC_KIND = "vesc_msgs/VescState"
_VECTOR = dict.fromkeys("xyz", "m")
_SCAN = {
    **dict.fromkeys(("angle_min", "angle_max", "angle_increment"), "rad"),
    **dict.fromkeys(("time_increment", "scan_time"), "s"),
    **dict.fromkeys(("range_min", "range_max", "ranges"), "m"),
}
_TIME = {"sec": "s", "nanosec": "ns"}
_PLACE = {"latitude": "deg", "longitude": "deg", "altitude": "m"}
_CHARGE = dict.fromkeys(("charge", "capacity", "design_capacity"), "Ah")
# Units by message type and field, from the comments in the types' definitions and from REP 103. The unit of a
# field is also that of the numbers inside it.
_OF_TYPES: Mapping[str, Mapping[str, str]] = {
    "ackermann_msgs/AckermannDrive": {
        "steering_angle": "rad",
        "steering_angle_velocity": "rad/s",
        "speed": "m/s",
        "acceleration": "m/s^2",
        "jerk": "m/s^3",
    },
    "duration": _TIME,
    "geographic_msgs/GeoPoint": _PLACE,
    "geometry_msgs/Accel": {"linear": "m/s^2", "angular": "rad/s^2"},
    "geometry_msgs/Point": _VECTOR,
    "geometry_msgs/Point32": _VECTOR,
    "geometry_msgs/Pose2D": {"x": "m", "y": "m", "theta": "rad"},
    "geometry_msgs/Transform": {"translation": "m"},
    "geometry_msgs/Twist": {"linear": "m/s", "angular": "rad/s"},
    "geometry_msgs/Wrench": {"force": "N", "torque": "N m"},
    "sensor_msgs/BatteryState": {
        "voltage": "V",
        "cell_voltage": "V",
        "temperature": "degC",
        "cell_temperature": "degC",
        "current": "A",
        **_CHARGE,
        "percentage": "1",
    },
    "sensor_msgs/FluidPressure": {"fluid_pressure": "Pa"},
    "sensor_msgs/Illuminance": {"illuminance": "lx"},
    "sensor_msgs/Imu": {"linear_acceleration": "m/s^2", "angular_velocity": "rad/s"},
    "sensor_msgs/LaserScan": _SCAN,
    "sensor_msgs/MagneticField": {"magnetic_field": "T"},
    "sensor_msgs/MultiEchoLaserScan": _SCAN,
    "sensor_msgs/NavSatFix": {**_PLACE, "position_covariance": "m^2"},
    "sensor_msgs/Range": {"field_of_view": "rad", "min_range": "m", "max_range": "m", "range": "m"},
    "sensor_msgs/RelativeHumidity": {"relative_humidity": "1"},
    "sensor_msgs/Temperature": {"temperature": "degC"},
    "time": _TIME,
}
# Columns that VESC Tool adds to a log, where the unit is certain.
_OF_LOGS = {
    "gnss_lat": "deg",
    "gnss_lon": "deg",
    "gnss_alt": "m",
    "gnss_gVel": "m/s",
    "gnss_vVel": "m/s",
    "gnss_hAcc": "m",
    "gnss_vAcc": "m",
    "speed_meters_per_sec": "m/s",
    "tacho_meters": "m",
    "tacho_abs_meters": "m",
    "current_in_setup": "A",
    "current_motor_setup": "A",
    "battery_wh_tot": "Wh",
}
# Units of the fields x, y and z within a field of such a name, where the type is unknown.
ROS_UNITS = {
    "linear_acceleration": "m/s^2",
    "angular_velocity": "rad/s",
    "twist.linear": "m/s",
    "twist.angular": "rad/s",
    "position": "m",
    "translation": "m",
}


def unit(stream: str, name: str, *, ros2: bool = False, kind: MessageType | None = None) -> str:
    """The unit of a field or of one of its statistics; empty if unknown.

    ``ros2`` tells that the samples are the ROS 2 driver's; ``kind`` is the type of the stream's messages.
    """
    stem, _, statistic = name.rpartition("_")
    for field in (name, stem) if statistic in STATS else (name,):
        if found := _unit(stream, field, kind, ros2=ros2):
            return found
    return ""


def _unit(stream: str, field: str, kind: MessageType | None, *, ros2: bool) -> str:
    if field in DERIVED_UNITS:
        return DERIVED_UNITS[field]
    if stream == RTT_STREAM and field in RTT_FIELDS.values():
        return "ms"
    if stream == AGENT_STREAM and field in AGENT_FIELDS:
        return agent_unit(field)
    if kind is not None and (found := _by_type(kind, field, ros2=ros2)):
        return found
    if stream == VESC_STREAM and field in VESC_FIELDS:
        return _of_a_vesc(field, ros2=ros2)
    if field in _OF_LOGS and (stream == VESC_STREAM if kind is None else kind.kind == VESC_KIND):
        return _OF_LOGS[field]
    # The driver's VescImu has fields of these names in other units.
    if kind is not None and kind.kind.startswith("vesc_msgs/"):
        return ""
    within, _, axis = field.rpartition(".")
    known_as = (of for of in ROS_UNITS if within == of or within.endswith(f".{of}"))
    return next((ROS_UNITS[of] for of in known_as), "") if axis in {"x", "y", "z"} else ""


def _of_a_vesc(field: str, *, ros2: bool) -> str:
    known = VESC_FIELDS[field]
    return (known.ros2_unit if ros2 else None) or known.unit


def _by_type(kind: MessageType, path: str, *, ros2: bool) -> str:
    types = _types(kind.kind, kind.definition)
    body = [field for field in types.get(kind.kind, ()) if field.name != "header"]
    # With a header and one other field, the sample's fields are that field's: see
    # contract/iort_contract/ros1/decode.py.
    starts = [body[0].kind, kind.kind] if len(body) == 1 else [kind.kind]
    return next(filter(None, (_on_the_way(types, start, path, ros2=ros2) for start in starts)), "")


def _on_the_way(types: Mapping[str, Fields], kind: str, path: str, *, ros2: bool) -> str:
    """The unit that a type along the path gives to the next part of the path."""
    for part in path.split("."):
        if part.isdecimal():
            continue
        if kind.startswith(VESC_KIND) and part in VESC_FIELDS:
            return _of_a_vesc(part, ros2=ros2)
        if part in _OF_TYPES.get(kind, {}):
            return _OF_TYPES[kind][part]
        kind = next((field.kind for field in types.get(kind, ()) if field.name == part), "")
    return ""


@lru_cache(maxsize=256)
def _types(kind: str, definition: str) -> Mapping[str, Fields]:
    """The fields of a type and of the types inside it; empty for an invalid definition."""
    try:
        return parse(kind, definition).types
    except MessageError:
        return {}


def agent_unit(field: str) -> str:
    """The unit of one of the agent's own metrics."""
    return AGENT_FIELDS[field].split()[0].rstrip(",")
