"""An rclpy publisher in its own process: `publisher.py NAME TOPIC TYPE [--field counter] ...`.

It sends values of ``field`` that count up; see `testkit.publishing.count`.
"""

import rclpy
import yaml
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rosidl_runtime_py import set_message_fields
from rosidl_runtime_py.utilities import get_message

from testkit.publishing import count, counter_options

parser = counter_options()
parser.add_argument("--values", default="{}", help="other fields, as JSON or YAML")
parser.add_argument("--best-effort", action="store_true")
parser.add_argument("--namespace", default="")
parser.add_argument("--hex", help="these bytes instead of a message")
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
message = Class()
set_message_fields(message, yaml.safe_load(options.values))
content = bytes.fromhex(options.hex) if options.hex else None
count(message, options, publisher.get_subscription_count, lambda one: publisher.publish(content or one))
node.destroy_node()
rclpy.shutdown()
