"""Units of fields, whoever they come from."""

from __future__ import annotations

import pytest

from contract import AGENT_STREAM, RTT_STREAM, VESC_STREAM
from station.units import unit


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
def test_a_field_has_the_unit_that_is_known_of_it(stream: str, name: str, expected: str) -> None:
    assert unit(stream, name) == expected
