"""A load of the bench on a ROS 2 graph; runs under a Python with rclpy.

    python -m bench.ros.ros2_publisher LOAD MESSAGES SUBSCRIBERS

Waits for the subscribers of each topic, then for a line on its input. Publishes so many prepared messages of
each topic, reliably and in turns, with stamps of now. At the end it prints their number, and ends after a
line. It publishes bytes, as making a message of Python's objects would take most of a core.
"""

import math
import struct
import sys
import time
from typing import Any

import rclpy
from rclpy.qos import QoSProfile
from rclpy.serialization import serialize_message
from rosidl_runtime_py.utilities import get_message

from bench.ros.ros2_loads import LARGE, LOADS
from testkit.publishing import Deadlines, ready, say

# A second of the fastest topic, and more.
_DEPTH = 2000
_BODIES = 97
_JOIN_S = 60


def bodies(kind: str) -> list[bytearray]:
    """Messages of a type, with some noise."""
    made = []
    for i in range(_BODIES):
        message: Any = get_message(kind)()
        message.header.frame_id = "base_link"
        if hasattr(message, "data"):
            message.format = "jpeg"
            message.data = bytes((i * 7 + k * k // 3) & 0xFF for k in range(LARGE))
        else:
            turn, pull = message.angular_velocity, message.linear_acceleration
            turn.z, turn.x = math.sin(i / 7), round(math.cos(i / 9) * 100) / 32768
            pull.x, pull.z = round(math.cos(i / 5) * 100) / 32768, 9.80665
            message.orientation.w, message.orientation.z = math.cos(i / 30), math.sin(i / 30)
        made.append(bytearray(serialize_message(message)))
    return made


def main() -> None:
    """Publish until every message is sent."""
    load, messages, subscribers = LOADS[sys.argv[1]], int(sys.argv[2]), int(sys.argv[3])
    rclpy.init(args=[])
    node = rclpy.create_node("bench_publisher")
    qos = QoSProfile(depth=_DEPTH)
    publishers = [node.create_publisher(get_message(load.kind), topic, qos) for topic in load.topics]
    prepared = bodies(load.kind)
    ready(
        lambda: min(publisher.get_subscription_count() for publisher in publishers),
        subscribers,
        within_s=_JOIN_S,
    )
    sys.stdin.readline()
    deadlines, at_once = Deadlines(), len(publishers) if load.together else 1
    every_s = at_once / (load.rate_hz * len(publishers))
    for n in range(messages * len(publishers)):
        deadlines.wait(n // at_once * every_s)
        body = prepared[n % _BODIES]
        struct.pack_into("<iI", body, 4, *divmod(time.time_ns(), 1_000_000_000))
        publishers[n % len(publishers)].publish(bytes(body))
    say(f"{messages * len(publishers)}")
    sys.stdin.readline()
    node.destroy_node()
    rclpy.shutdown()


main()
