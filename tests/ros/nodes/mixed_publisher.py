"""One node of the mixed robot, in its own process: `mixed_publisher.py NODE --seconds 40 --sent FILE`.

It publishes prepared bytes of types that are not installed; see `testkit.publishing.prove`.
"""

import rospy

from testkit.publishing import Recorded, node_options, prove
from testkit.ros1_types import header
from tests.ros.mixed.robot import NODES, Maker

parser = node_options(NODES)
parser.add_argument("--topics", nargs="*", help="these alone")
options = parser.parse_args()


class Bytes(rospy.AnyMsg):
    """A message that consists of its bytes."""

    def __init__(self, *content):
        super().__init__()
        if content:
            (self._buff,) = content


class Publisher(Recorded):
    """One topic: every message has its own header, if the type has one."""

    def __init__(self, topic, seed):
        super().__init__(topic, options)
        message = topic.message
        names = {"_type": topic.kind, "_md5sum": message.md5sum, "_full_text": message.definition}
        self._maker = Maker(topic, seed)
        self._publisher = rospy.Publisher(
            topic.name, type("Bytes", (Bytes,), names), queue_size=2000, latch=topic.latched, tcp_nodelay=True
        )
        self.subscribers = self._publisher.get_num_connections

    def send(self, now_ns):
        now_us = now_ns // 1000 - self.topic.behind_us
        stamp_us = now_us - now_us % self.topic.grid_us
        content = self._maker.made(self.sent, header(self.sent, stamp_us, options.node.encode()))
        self._publisher.publish(content)
        return content


rospy.init_node(options.node, disable_signals=True, disable_rosout=True)
topics = [topic for topic in NODES[options.node] if not options.topics or topic.name in options.topics]
prove([Publisher(topic, options.seed + i) for i, topic in enumerate(topics)], options)
rospy.signal_shutdown("done")
