"""Units of the fields of standard ROS messages."""

from __future__ import annotations

from typing import Mapping

_VECTOR = dict.fromkeys("xyz", "m")
_SCAN = {
    **dict.fromkeys(("angle_min", "angle_max", "angle_increment"), "rad"),
    **dict.fromkeys(("time_increment", "scan_time"), "s"),
    **dict.fromkeys(("range_min", "range_max", "ranges"), "m"),
}
_TIME = {"sec": "s", "nanosec": "ns"}
_PLACE = {"latitude": "deg", "longitude": "deg", "altitude": "m"}
_CHARGE = dict.fromkeys(("charge", "capacity", "design_capacity"), "Ah")
# Type -> field -> unit of the field, or of the numbers within it. Sources: the comments of the types'
# definitions, and REP 103.
TYPE_UNITS: Mapping[str, Mapping[str, str]] = {
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
# Field -> unit of the fields x, y and z within it, for samples without a known type.
ROS_UNITS = {
    "linear_acceleration": "m/s^2",
    "angular_velocity": "rad/s",
    "twist.linear": "m/s",
    "twist.angular": "rad/s",
    "position": "m",
    "translation": "m",
}
