"""An rclpy publisher in its own process: `publisher.py NAME TOPIC TYPE [--field counter] ...`.

It sends values of ``field`` that count up, and prints ``ready`` when a subscriber is there. The line ``quit``
on standard input ends it; its last line is ``sent N``.
"""

# ruff: noqa: T201 - standard output goes to the test that started it

import argparse
import sys
import threading
import time

import rclpy
import yaml
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rosidl_runtime_py import set_message_fields
from rosidl_runtime_py.utilities import get_message

parser = argparse.ArgumentParser()
parser.add_argument("name")
parser.add_argument("topic")
parser.add_argument("type", help="package/msg/Type")
parser.add_argument("--field", help="dotted path of the field that counts")
parser.add_argument("--values", default="{}", help="other fields, as JSON or YAML")
parser.add_argument("--rate", type=float, default=50)
parser.add_argument("--start", type=int, default=0, help="the first value of the counter")
parser.add_argument("--count", type=int, default=0, help="stop counting after so many")
parser.add_argument("--stamp", default="now", help="now, or seconds since the epoch")
parser.add_argument("--latch", action="store_true", help="transient local")
parser.add_argument("--best-effort", action="store_true")
parser.add_argument("--namespace", default="")
parser.add_argument("--hex", help="these bytes instead of a message")
parser.add_argument("--at-once", action="store_true", help="wait for no subscriber")
options = parser.parse_args()

rclpy.init(args=[])
node = rclpy.create_node(options.name, namespace=options.namespace)
Class = get_message(options.type)
qos = QoSProfile(depth=1000)
if options.latch:
    qos.depth, qos.durability = 1, DurabilityPolicy.TRANSIENT_LOCAL
if options.best_effort:
    qos.reliability = ReliabilityPolicy.BEST_EFFORT
publisher = node.create_publisher(Class, options.topic, qos)
stop = threading.Event()


def listen():
    for line in sys.stdin:
        if line.strip() == "quit":
            break
    stop.set()


threading.Thread(target=listen, daemon=True).start()
while not options.at_once and publisher.get_subscription_count() == 0 and not stop.is_set():
    stop.wait(0.01)
print("ready", flush=True)

message, n, began = Class(), 0, time.monotonic()
set_message_fields(message, yaml.safe_load(options.values))
target, last = message, None
if options.field:
    *path, last = options.field.split(".")
    for name in path:
        target = getattr(target, name)
while not stop.is_set():
    if options.count and n >= options.count:
        stop.wait()
        break
    if last:
        value = options.start + n
        setattr(target, last, type(getattr(target, last))(value))
    if hasattr(message, "header"):
        ns = time.time_ns() if options.stamp == "now" else int(float(options.stamp) * 1e9)
        message.header.stamp.sec, message.header.stamp.nanosec = divmod(ns, 10**9)
        message.header.frame_id = "base_link"
    publisher.publish(bytes.fromhex(options.hex) if options.hex else message)
    n += 1
    stop.wait(max(0.0, began + n / options.rate - time.monotonic()))
print(f"sent {n}", flush=True)
node.destroy_node()
rclpy.shutdown()
