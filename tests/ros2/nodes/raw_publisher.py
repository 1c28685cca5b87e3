"""An rclpy publisher of whatever it is told, in its own process: `raw_publisher.py NAME TOPIC=TYPE ...`.

It prints ``ready`` when every topic has a subscriber. Each line of input is a command: ``send TOPIC BASE64``
(these bytes, whatever the type), ``large TOPIC BYTES`` (a message whose field ``data`` is so long),
``each COUNT`` (so many messages of every topic, whose field ``data`` counts from 0), ``quit``. It prints
``done`` after each.
"""

import base64
import sys
import time

import rclpy
from rclpy.qos import QoSProfile
from rosidl_runtime_py.utilities import get_message

from testkit.publishing import say

name, kinds = sys.argv[1], dict(one.split("=") for one in sys.argv[2:])
rclpy.init(args=[])
node = rclpy.create_node(name)
publishers = {
    topic: node.create_publisher(get_message(kind), topic, QoSProfile(depth=1000))
    for topic, kind in kinds.items()
}
while any(publisher.get_subscription_count() < 1 for publisher in publishers.values()):
    time.sleep(0.02)
say("ready")
for line in sys.stdin:
    command, *rest = line.split()
    if command == "quit":
        break
    if command == "send":
        topic, content = rest[0], base64.b64decode(rest[1] if len(rest) > 1 else "")
        try:
            publishers[topic].publish(content)
        except Exception as error:  # noqa: BLE001 - the middleware refuses the bytes; the test is told
            say(f"refused {error}".replace("\n", " "))
    elif command == "large":
        message = get_message(kinds[rest[0]])()
        message.data = bytes(int(rest[1]))
        publishers[rest[0]].publish(message)
    else:
        for n in range(int(rest[0])):
            for topic, publisher in publishers.items():
                message = get_message(kinds[topic])()
                message.data = float(n)
                publisher.publish(message)
            time.sleep(0.02)
    say("done")
node.destroy_node()
rclpy.shutdown()
