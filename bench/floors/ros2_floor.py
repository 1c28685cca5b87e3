"""The floor: a bare rclpy subscriber of some topics, raw, on its executor. It counts messages.

    python -m bench.floors.ros2_floor TYPE TOPIC ... [--delays FILE]

With --delays it also writes each message's time under way, in ms, by the stamp of its header.
"""

import argparse
import json
import struct
import sys
import threading
import time
from pathlib import Path

import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import QoSProfile
from rosidl_runtime_py.utilities import get_message

parser = argparse.ArgumentParser()
parser.add_argument("kind")
parser.add_argument("topics", nargs="+")
parser.add_argument("--delays", type=Path)
options = parser.parse_args()
count, delays_ms = 0, list[float]()


def take(_message: bytes) -> None:
    """Count a message."""
    global count  # noqa: PLW0603 - as bare as it gets
    count += 1


def measure(message: bytes) -> None:
    """Note how long a message was under way."""
    now_ns = time.time_ns()
    # The stamp is first, after the encapsulation header.
    sec, nanosec = struct.unpack_from("<iI", message, 4)
    delays_ms.append((now_ns - sec * 1_000_000_000 - nanosec) / 1e6)


rclpy.init(args=[])
node = rclpy.create_node("bench_floor")
kind, callback = get_message(options.kind), measure if options.delays else take
subscriptions = [
    node.create_subscription(kind, topic, callback, QoSProfile(depth=1000), raw=True)
    for topic in options.topics
]
executor = SingleThreadedExecutor()
executor.add_node(node)
threading.Thread(target=executor.spin, daemon=True).start()
sys.stdin.readline()
# What came last may still wait for the executor.
before = -1
while before != (before := count + len(delays_ms)):
    time.sleep(0.5)
if options.delays:
    options.delays.write_text(json.dumps(delays_ms))
print(before, flush=True)
