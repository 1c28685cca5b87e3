"""One node of the mixed robot, in its own process: `mixed_publisher.py NODE --seconds 40`.

It publishes prepared bytes of types that are not installed. It prints ``ready`` when every topic has its
subscribers, begins at a line on its input, prints ``sent {...}`` with the number of messages by topic, and
ends at the next line. The sent log has a line for each message: topic and base64. When a topic's number of
connections changes, it prints JSON with the number of the message that found the change.
"""

# ruff: noqa: T201 - standard output goes to the test that started it

import argparse
import base64
import json
import sys
import time

import rospy

from testkit.ros1_types import header
from tests.ros.mixed.robot import NODES, Maker

parser = argparse.ArgumentParser()
parser.add_argument("node", choices=NODES)
parser.add_argument("--seconds", type=float, required=True)
parser.add_argument("--sent-log", type=argparse.FileType("w"), required=True)
parser.add_argument("--subscribers", type=int, default=2)
parser.add_argument("--seed", type=int, default=1)
parser.add_argument("--topics", nargs="*", help="these alone")
options = parser.parse_args()


class Bytes(rospy.AnyMsg):
    """A message that consists of its bytes."""

    def __init__(self, *content):
        super().__init__()
        if content:
            (self._buff,) = content


class Publisher:
    """One topic: every message has its own header, if the type has one."""

    def __init__(self, topic, seed):
        message = topic.message
        names = {"_type": topic.kind, "_md5sum": message.md5sum, "_full_text": message.definition}
        self.topic, self.sent, self.connections = topic, 0, 0
        self.due_s = 0.0
        self._maker = Maker(topic, seed)
        self.publisher = rospy.Publisher(
            topic.name, type("Bytes", (Bytes,), names), queue_size=2000, latch=topic.latched, tcp_nodelay=True
        )

    def publish(self):
        topic, connections = self.topic, self.publisher.get_num_connections()
        if connections != self.connections:
            self.connections = connections
            found = {"topic": topic.name, "node": options.node, "n": self.sent, "connections": connections}
            print(json.dumps(found), flush=True)
        now_us = time.time_ns() // 1000 - topic.behind_us
        stamp_us = now_us - now_us % topic.grid_us
        content = self._maker.made(self.sent, header(self.sent, stamp_us, options.node.encode()))
        self.publisher.publish(content)
        options.sent_log.write(f"{topic.name} {base64.b64encode(content).decode()}\n")
        self.sent += 1
        # A message without a rate is published once.
        self.due_s = self.sent / topic.rate_hz if topic.rate_hz else options.seconds


rospy.init_node(options.node, disable_signals=True, disable_rosout=True)
topics = [topic for topic in NODES[options.node] if not options.topics or topic.name in options.topics]
publishers = [Publisher(topic, options.seed + i) for i, topic in enumerate(topics)]
while min(one.publisher.get_num_connections() for one in publishers) < options.subscribers:
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
options.sent_log.close()
print("sent " + json.dumps({one.topic.name: one.sent for one in publishers}), flush=True)
sys.stdin.readline()
rospy.signal_shutdown("done")
