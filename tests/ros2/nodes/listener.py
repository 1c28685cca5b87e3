"""An rclpy subscriber that knows nothing of the agent: ``listener.py NAME TOPIC TYPE`` prints each message as
a line of JSON, with the time of its arrival, and ``connected`` and ``publishers N`` when there are any or
others. ``--latched`` asks for what was published before.
"""

import json
import sys
import threading
import time

import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import DurabilityPolicy, QoSProfile
from rosidl_runtime_py import message_to_ordereddict
from rosidl_runtime_py.utilities import get_message

from testkit.publishing import say

name, topic, kind = sys.argv[1:4]
rclpy.init(args=[])
node = rclpy.create_node(name)
qos = QoSProfile(depth=1000)
if "--latched" in sys.argv:
    qos.durability = DurabilityPolicy.TRANSIENT_LOCAL
subscription = node.create_subscription(
    get_message(kind),
    topic,
    lambda message: say(json.dumps([time.time(), message_to_ordereddict(message)])),
    qos,
)
executor, stop = SingleThreadedExecutor(), threading.Event()
executor.add_node(node)


def listen():
    sys.stdin.readline()
    stop.set()
    executor.wake()


threading.Thread(target=listen, daemon=True).start()
publishers = 0
while not stop.is_set():
    executor.spin_once(timeout_sec=0.1)
    if (count := node.count_publishers(topic)) != publishers:
        if not publishers:
            say("connected")
        say(f"publishers {count}")
        publishers = count
node.destroy_node()
rclpy.shutdown()
