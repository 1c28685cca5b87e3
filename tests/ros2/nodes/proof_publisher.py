"""One node of the proof's robot, in its own process: `proof_publisher.py NODE --seconds 40 --sent FILE`.

It serializes every message itself, publishes the bytes, and writes them to its record: a line of topic, time
in ns and base64. It prints ``ready`` when every topic has its subscribers, begins at a line on its input,
prints ``sent {...}`` with the number of messages by topic, and ends at the next line. When a topic's number
of subscribers changes, it prints JSON with the number of the message that found the change.
"""

# ruff: noqa: T201 - standard output goes to the test that started it

import argparse
import base64
import json
import sys
import time

import rclpy
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.serialization import serialize_message
from rosidl_runtime_py.utilities import get_message

from tests.ros2.nodes.random_message import Values
from tests.ros2.proof.robot import NODES

parser = argparse.ArgumentParser()
parser.add_argument("node", choices=NODES)
parser.add_argument("--seconds", type=float, required=True)
parser.add_argument("--sent", type=argparse.FileType("w"), required=True)
parser.add_argument("--subscribers", type=int, default=2)
parser.add_argument("--seed", type=int, default=1)
parser.add_argument("--without", nargs="*", default=(), help="topics, since their package is not installed")
options = parser.parse_args()


class Publisher:
    """One topic: every message has its own header, if the type has one."""

    def __init__(self, node, topic, seed):
        self.topic, self.sent, self.subscribers, self.due_s = topic, 0, 0, 0.0
        self._kind = get_message(topic.kind)
        self._stamped = self._kind.get_fields_and_field_types().get("header") == "std_msgs/Header"
        self._values = Values(seed, topic.lengths)
        # A large body may repeat: its header makes the message unique.
        self._body = self._kind() if max(topic.lengths.values(), default=0) > 100 and self._stamped else None
        if self._body is not None:
            self._values.fill(self._body)
        qos = QoSProfile(depth=1 if topic.latched else 2000)
        if topic.latched:
            qos.durability = DurabilityPolicy.TRANSIENT_LOCAL
        if topic.best_effort:
            qos.depth, qos.reliability = 10, ReliabilityPolicy.BEST_EFFORT
        self.publisher = node.create_publisher(self._kind, topic.name, qos)

    def publish(self):
        topic, subscribers = self.topic, self.publisher.get_subscription_count()
        if subscribers != self.subscribers:
            self.subscribers = subscribers
            found = {"topic": topic.name, "n": self.sent, "subscribers": subscribers, "t_ns": time.time_ns()}
            print(json.dumps(found), flush=True)
        message = self._values.fill(self._kind()) if self._body is None else self._body
        now_ns = time.time_ns()
        if self._stamped:
            message.header.stamp.sec, message.header.stamp.nanosec = divmod(now_ns, 10**9)
            message.header.frame_id = f"{options.node} {self.sent}"
        content = serialize_message(message)
        self.publisher.publish(content)
        options.sent.write(f"{topic.name} {now_ns} {base64.b64encode(content).decode()}\n")
        self.sent += 1
        # A topic without a rate is published once.
        self.due_s = self.sent / topic.rate_hz if topic.rate_hz else options.seconds


rclpy.init(args=[])
node = rclpy.create_node(f"proof_{options.node}")
topics = [topic for topic in NODES[options.node] if topic.name not in options.without]
publishers = [Publisher(node, topic, options.seed + i) for i, topic in enumerate(topics)]
while min(one.publisher.get_subscription_count() for one in publishers) < options.subscribers:
    time.sleep(0.05)
print("ready", flush=True)
sys.stdin.readline()
began = time.monotonic()
while True:
    # Publish the topic that is due; a loop over twenty topics costs less than a thread for each.
    one = min(publishers, key=lambda one: one.due_s)
    if one.due_s >= options.seconds:
        break
    ahead_s = began + one.due_s - time.monotonic()
    if ahead_s > 0:
        time.sleep(ahead_s)
    one.publish()
options.sent.close()
print("sent " + json.dumps({one.topic.name: one.sent for one in publishers}), flush=True)
# What is published stays available to reliable subscribers until then.
sys.stdin.readline()
node.destroy_node()
rclpy.shutdown()
