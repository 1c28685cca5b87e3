"""Units of fields, from any source."""

from __future__ import annotations

import pytest

from iort_contract.catalog.streams import AGENT_STREAM, RTT_STREAM
from iort_contract.catalog.vesc import VESC_STREAM
from iort_contract.messages.message_type import MessageType
from iort_station.data.inventory import unit


@pytest.mark.parametrize(
    ("stream", "name", "expected"),
    [
        (VESC_STREAM, "speed", "erpm"),
        (VESC_STREAM, "speed_mps_max", "m/s"),
        (RTT_STREAM, "rule_ms", "ms"),
        (AGENT_STREAM, "cpu_percent", "%"),
        (AGENT_STREAM, "clock_offset_ms", "ms"),
        ("imu", "linear_acceleration.x", "m/s^2"),
        ("imu", "angular_velocity.z_mean", "rad/s"),
        ("odom", "twist.twist.linear.y", "m/s"),
        ("odom", "pose.pose.position.z", "m"),
        ("odom", "pose.pose.orientation.z", ""),
        ("odom", "composition.x", ""),
        ("odom", "position", ""),
        ("lab", "linear.x", ""),
    ],
)
def test_a_field_has_its_known_unit(stream: str, name: str, expected: str) -> None:
    assert unit(stream, name) == expected


LINE = "=" * 80 + "\n"
HEADER = LINE + "MSG: std_msgs/Header\nuint32 seq\ntime stamp\nstring frame_id\n"
VECTOR = LINE + "MSG: geometry_msgs/Vector3\nfloat64 x\nfloat64 y\nfloat64 z\n"
VESC_STATE = LINE + "MSG: vesc_msgs/VescState\nfloat64 speed\nfloat64 charge_drawn\nint32 fault_code\n"
STAMPED_VESC = "Header header\nvesc_msgs/VescState state\n" + HEADER + VESC_STATE
FIX = "Header header\nfloat64 latitude\nfloat64 altitude\nfloat64[9] position_covariance\n" + HEADER
DRIVE = "Header header\nackermann_msgs/AckermannDrive drive\n" + HEADER + LINE
DRIVE += "MSG: ackermann_msgs/AckermannDrive\nfloat32 steering_angle\nfloat32 speed\n"
IMU = "Header header\nVescImu imu\n" + HEADER + LINE + "MSG: vesc_msgs/VescImu\n"
IMU += "geometry_msgs/Vector3 linear_acceleration\n" + VECTOR
OWN = "vesc_msgs/VescState[2] motors\nsensor_msgs/Range near\ngeometry_msgs/Vector3 angular_velocity\n"
OWN += "float64 speed\n" + VESC_STATE + LINE + "MSG: sensor_msgs/Range\nfloat32 range\n" + VECTOR


@pytest.mark.parametrize(
    ("kind", "definition", "name", "expected"),
    [
        ("vesc_msgs/VescStateStamped", STAMPED_VESC, "speed", "erpm"),
        ("vesc_msgs/VescStateStamped", STAMPED_VESC, "charge_drawn_max", "1e-4 Ah"),
        ("vesc_msgs/VescStateStamped", STAMPED_VESC, "state.speed", "erpm"),
        ("vesc_msgs/VescStateStamped", "", "speed", "erpm"),
        ("vesc_msgs/VescStateStamped", "what is this", "speed_mean", "erpm"),
        ("vesc_msgs/VescStateStamped", STAMPED_VESC, "speed_mps", "m/s"),
        ("vesc_msgs/VescImuStamped", IMU, "linear_acceleration.x", ""),
        ("sensor_msgs/NavSatFix", FIX, "latitude", "deg"),
        ("sensor_msgs/NavSatFix", FIX, "altitude_mean", "m"),
        ("sensor_msgs/NavSatFix", FIX, "position_covariance.3", "m^2"),
        ("ackermann_msgs/AckermannDriveStamped", DRIVE, "speed", "m/s"),
        ("lab/Robot", OWN, "motors.1.speed", "erpm"),
        ("lab/Robot", OWN, "near.range_min", "m"),
        ("lab/Robot", OWN, "angular_velocity.z", "rad/s"),
        ("lab/Robot", OWN, "speed", ""),
        ("lab/Robot", OWN, "nothing", ""),
    ],
)  # fmt: skip
def test_the_unit_follows_from_the_type_of_the_messages(kind, definition, name, expected):
    assert unit("any", name, kind=MessageType("any", "/t", kind, "", definition)) == expected


def test_the_ros_2_driver_has_its_own_units_in_any_stream():
    kind = MessageType("esc", "/t", "vesc_msgs/VescStateStamped", "", STAMPED_VESC)
    assert unit("esc", "charge_drawn", ros2=True, kind=kind) == "Ah"


@pytest.mark.parametrize(
    ("stream", "expected"), [(VESC_STREAM, "deg"), ("lab", "")], ids=["a log's", "somebody's"]
)
def test_the_columns_of_a_log_have_units(stream, expected):
    assert unit(stream, "gnss_lat") == expected
