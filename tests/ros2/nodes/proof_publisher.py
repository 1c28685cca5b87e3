"""One node of the proof's robot, in its own process: `proof_publisher.py NODE --seconds 40 --sent FILE`.

It serializes every message itself, and publishes the bytes; see `testkit.publishing.prove`.
"""

import rclpy
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.serialization import serialize_message
from rosidl_runtime_py.utilities import get_message

from testkit.publishing import Recorded, node_options, prove
from tests.ros2.nodes.random_message import Values
from tests.ros2.proof.robot import NODES

parser = node_options(NODES)
parser.add_argument("--without", nargs="*", default=(), help="topics, since their package is not installed")
options = parser.parse_args()


class Publisher(Recorded):
    """One topic: every message has its own header, if the type has one."""

    def __init__(self, node, topic, seed):
        super().__init__(topic, options)
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
        self._publisher = node.create_publisher(self._kind, topic.name, qos)
        self.subscribers = self._publisher.get_subscription_count

    def send(self, now_ns):
        message = self._values.fill(self._kind()) if self._body is None else self._body
        if self._stamped:
            message.header.stamp.sec, message.header.stamp.nanosec = divmod(now_ns, 10**9)
            message.header.frame_id = f"{options.node} {self.sent}"
        content = serialize_message(message)
        self._publisher.publish(content)
        return content


rclpy.init(args=[])
node = rclpy.create_node(f"proof_{options.node}")
topics = [topic for topic in NODES[options.node] if topic.name not in options.without]
prove([Publisher(node, topic, options.seed + i) for i, topic in enumerate(topics)], options)
node.destroy_node()
rclpy.shutdown()
