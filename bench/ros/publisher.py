"""One node of the bench's robot; runs under a Python with rospy.

python -m bench.ros.publisher NODE SECONDS SUBSCRIBERS [RATE_HZ]

Waits for the subscribers of each of its topics, then for a line on its input. Publishes each topic at its
rate, or at RATE_HZ, with time stamps of now. At the end it prints the number of messages by topic, as JSON.
"""

import json
import math
import sys
import time
from typing import Any

import genpy.dynamic
import rospy

from bench.ros.mixed_robot import HEADER, NODES, Topic
from testkit.publishing import publish_in_turn, ready, say

# Messages that a subscriber's connection may hold: a second of the fastest topic.
_QUEUE = 1000


class Line:
    """One topic, with its publisher and its next message. Without a rate it is published once."""

    def __init__(self, topic: Topic, rate_hz: float) -> None:
        self.topic, self.rate_hz, self.sent, self.due_s = topic, rate_hz, 0, 0.0
        self._classes: Any = genpy.dynamic.generate_dynamic(topic.kind, topic.definition)
        self._message = self._classes[topic.kind]()
        self.publisher = rospy.Publisher(
            topic.name, type(self._message), queue_size=_QUEUE, tcp_nodelay=True, latch=rate_hz == 0
        )

    def publish(self) -> None:
        self.topic.fill(self._message, self._classes, self.sent)
        if self.topic.time == HEADER:
            self._message.header.stamp = genpy.Time.from_sec(time.time())
            self._message.header.frame_id = self.topic.frame
        self.publisher.publish(self._message)
        self.sent += 1
        self.due_s = self.sent / self.rate_hz if self.rate_hz else math.inf


def main() -> None:
    """Publish until the seconds are over."""
    node, seconds, subscribers = sys.argv[1], float(sys.argv[2]), int(sys.argv[3])
    rospy.init_node(node, disable_signals=True)
    rate_hz = float(sys.argv[4]) if len(sys.argv) > 4 else None
    lines = [Line(topic, topic.rate_hz if rate_hz is None else rate_hz) for topic in NODES[node]]
    ready(lambda: min(line.publisher.get_num_connections() for line in lines), subscribers)
    sys.stdin.readline()
    publish_in_turn(lines, seconds)
    say(json.dumps({line.topic.name: line.sent for line in lines}))
    sys.stdin.readline()


main()
