"""The loads of the bench on a ROS 2 graph: topics of one type at one rate."""

from __future__ import annotations

from dataclasses import dataclass

# Bytes of a large message.
LARGE = 100_000
IMU = "sensor_msgs/msg/Imu"


@dataclass(frozen=True)
class Load:
    """Topics of a type whose messages begin with a header. They are published one after another, evenly, or
    ``together``, as those of one controller are.
    """

    title: str
    kind: str
    topics: tuple[str, ...]
    rate_hz: int
    together: bool = False


FAST, MANY, SPREAD, BIG, LIVE = "fast", "many", "spread", "big", "live"
_FIFTY = tuple(f"/imu/t{i:02}" for i in range(50))
LOADS = {
    FAST: Load("1 topic of 1000 Hz", IMU, ("/imu",), 1000),
    MANY: Load("50 topics of 20 Hz, together", IMU, _FIFTY, 20, together=True),
    SPREAD: Load("50 topics of 20 Hz, evenly", IMU, _FIFTY, 20),
    BIG: Load("1 topic of 30 Hz, 100 KB", "sensor_msgs/msg/CompressedImage", ("/camera",), 30),
    LIVE: Load("1 topic of 50 Hz", IMU, ("/imu",), 50),
}
