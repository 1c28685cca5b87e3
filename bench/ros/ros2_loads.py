"""The loads of the bench on a ROS 2 graph: topics of one type at one rate."""

from __future__ import annotations

from dataclasses import dataclass

# Bytes of a large message.
LARGE = 100_000
IMU = "sensor_msgs/msg/Imu"


@dataclass(frozen=True)
class Load:
    """Topics of a type whose messages begin with a header."""

    title: str
    kind: str
    topics: tuple[str, ...]
    rate_hz: int


FAST, MANY, BIG, LIVE = "fast", "many", "big", "live"
LOADS = {
    FAST: Load("1 topic of 1000 Hz", IMU, ("/imu",), 1000),
    MANY: Load("50 topics of 20 Hz", IMU, tuple(f"/imu/t{i:02}" for i in range(50)), 20),
    BIG: Load("1 topic of 30 Hz, 100 KB", "sensor_msgs/msg/CompressedImage", ("/camera",), 30),
    LIVE: Load("1 topic of 50 Hz", IMU, ("/imu",), 50),
}
