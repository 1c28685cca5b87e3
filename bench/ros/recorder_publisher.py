"""The publisher of the event recorder's proof and bench; runs under a Python with the ROS.

    python -m bench.ros.recorder_publisher NAME FOLDER [--ros2] [--subscribers 1] [--latched]

It publishes 1,000 small messages, 30 of 100 KB and 20 demands a second, and with ``--latched`` one latched
message before anybody listens. Each has a stamp and a number of its own. It prints ``ready`` when every topic
has its subscribers and begins; FOLDER/NAME.sent has a line for each message: topic, number, time, stamp,
subscribers, SHA-256. Lines on its input:

- ``demand 3``: the next four demands are 3
- ``latch``: publish another latched message
- ``back 120``: stamps are so many seconds earlier from now on
- ``quit``: end
"""

from __future__ import annotations

import argparse
import hashlib
import os
import struct
import sys
import threading
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from testkit.publishing import Deadlines, ready, say

# Topic -> type and rate.
SMALL, LARGE = "geometry_msgs/PointStamped", "sensor_msgs/Image"
TOPICS = {"/small": (SMALL, 1000), "/large": (LARGE, 30), "/demand": (SMALL, 20)}
LATCHED = "/static"
LARGE_BYTES = 100_000
_DEMANDS = 4
_noise = os.urandom(2 * LARGE_BYTES)
# Publishes a message with this number, stamp in us and demand, and returns its bytes.
Publish = Callable[[int, int, float], bytes]
# Topic -> what publishes, and what counts the subscribers.
Topics = dict[str, tuple[Publish, Callable[[], int]]]
Rates = Mapping[str, tuple[str, int]]


def _data(n: int) -> bytes:
    return _noise[n % LARGE_BYTES :][:LARGE_BYTES]


def _ros1(name: str, rates: Rates) -> tuple[Topics, Callable[[], object]]:
    """The topics, and what ends them."""
    import rospy  # noqa: PLC0415 - only one of the two is there

    from testkit.ros1_types import MESSAGES, header  # noqa: PLC0415 - as above

    def topic(topic: str, kind: str, rate_hz: int) -> tuple[Publish, Callable[[], int]]:
        told = MESSAGES[kind]
        names = {"_type": kind, "_md5sum": told.md5sum, "_full_text": told.definition}
        # A message that consists of its bytes.
        of_bytes: Any = type("Bytes", (rospy.AnyMsg,), names)
        size, latch = max(1, 2 * rate_hz), topic == LATCHED
        made = rospy.Publisher(topic, of_bytes, queue_size=size, tcp_nodelay=True, latch=latch)

        def publish(n: int, stamp_us: int, demand: float) -> bytes:
            if kind == SMALL:
                body = struct.pack("<3d", demand, n, 0.0)
            else:
                sizes = 1, LARGE_BYTES, 5, b"8UC1 ", 0, LARGE_BYTES, LARGE_BYTES
                body = struct.pack("<III5sBII", *sizes) + _data(n)
            content: bytes = header(n, stamp_us, name.encode()) + body
            message = of_bytes()
            message._buff = content  # noqa: SLF001 - as rospy itself gives bytes
            made.publish(message)
            return content

        return publish, made.get_num_connections

    rospy.init_node(name, disable_signals=True, disable_rosout=True)
    topics = {one: topic(one, kind, rate_hz) for one, (kind, rate_hz) in rates.items()}
    return topics, lambda: rospy.signal_shutdown("done")


def _ros2(name: str, rates: Rates) -> tuple[Topics, Callable[[], object]]:
    """As `_ros1`."""
    import rclpy  # noqa: PLC0415 - only one of the two is there
    from rclpy.qos import DurabilityPolicy, QoSProfile  # noqa: PLC0415 - as above
    from rclpy.serialization import serialize_message  # noqa: PLC0415 - as above
    from rosidl_runtime_py.utilities import get_message  # noqa: PLC0415 - as above

    rclpy.init(args=[])
    node = rclpy.create_node(name)

    def topic(topic: str, kind: str, rate_hz: int) -> tuple[Publish, Callable[[], int]]:
        made_of: Any = get_message(kind.replace("/", "/msg/"))
        qos = QoSProfile(depth=max(1, 2 * rate_hz))
        if topic == LATCHED:
            qos.durability = DurabilityPolicy.TRANSIENT_LOCAL
        made, message = node.create_publisher(made_of, topic, qos), made_of()

        def publish(n: int, stamp_us: int, demand: float) -> bytes:
            stamp = message.header.stamp
            stamp.sec, stamp.nanosec = stamp_us // 1_000_000, stamp_us % 1_000_000 * 1000
            message.header.frame_id = f"{name} {n}"
            if kind == SMALL:
                message.point.x, message.point.y = demand, float(n)
            else:
                message.data = _data(n)
            content: bytes = serialize_message(message)
            made.publish(content)
            return content

        return publish, made.get_subscription_count

    return {one: topic(one, kind, rate_hz) for one, (kind, rate_hz) in rates.items()}, rclpy.shutdown


class _Orders:
    """What the lines of the input ask for."""

    def __init__(self) -> None:
        self.stop = threading.Event()
        self.back_us = self.latched = 0
        self._demand, self._left = 0.0, 0

    def listen(self) -> None:
        """Follow the lines until one asks for the end."""
        for line in sys.stdin:
            word, _, number = line.strip().partition(" ")
            if word == "demand":
                self._demand, self._left = float(number), _DEMANDS
            elif word == "latch":
                self.latched += 1
            elif word == "back":
                self.back_us = int(number) * 1_000_000
            else:
                break
        self.stop.set()

    def demand(self) -> float:
        """The next demand."""
        self._left -= 1
        return self._demand if self._left >= 0 else 0.0


def main() -> None:
    """Publish until the end is asked for."""
    parser = argparse.ArgumentParser()
    parser.add_argument("name")
    parser.add_argument("folder", type=Path)
    parser.add_argument("--ros2", action="store_true")
    parser.add_argument("--subscribers", type=int, default=1)
    parser.add_argument("--latched", action="store_true")
    options = parser.parse_args()
    rates: Rates = {**TOPICS, LATCHED: (SMALL, 0)} if options.latched else TOPICS
    topics, end = (_ros2 if options.ros2 else _ros1)(options.name, rates)
    orders = _Orders()
    sent = dict.fromkeys(topics, 0)
    with (options.folder / f"{options.name}.sent").open("w") as record:

        def publish(topic: str) -> None:
            publish, subscribers = topics[topic]
            n, count, now_us = sent[topic], subscribers(), time.time_ns() // 1000
            stamp_us = now_us - orders.back_us
            demand = orders.demand() if topic == "/demand" else 0.0
            digest = hashlib.sha256(publish(n, stamp_us, demand)).hexdigest()
            record.write(f"{topic} {n} {now_us} {stamp_us} {count} {digest}\n")
            sent[topic] = n + 1

        if options.latched:
            publish(LATCHED)
        ready(lambda: min(subscribers() for _, subscribers in topics.values()), options.subscribers)
        threading.Thread(target=orders.listen, daemon=True).start()
        deadlines = Deadlines()
        while not orders.stop.is_set():
            if options.latched and sent[LATCHED] <= orders.latched:
                publish(LATCHED)
            topic = min(TOPICS, key=lambda one: sent[one] / TOPICS[one][1])
            deadlines.wait(sent[topic] / TOPICS[topic][1])
            publish(topic)
    # What was published last is on its way.
    time.sleep(1)
    end()
    say(f"{sum(sent.values())}")


main()
