"""An rclpy node that asks: ``caller.py NAME QUESTION`` prints each answer as a line of JSON.

An empty line of input calls the service, another one is published as the body on the topic of that name. With
``--alone``, nobody answers on a topic.
"""

import json
import sys
import threading

import rclpy
from rclpy.executors import SingleThreadedExecutor
from std_msgs.msg import String
from std_srvs.srv import Trigger

from testkit.publishing import say

name, question = sys.argv[1:3]
alone = "--alone" in sys.argv
rclpy.init(args=[])
node = rclpy.create_node(name)
asked, answered = f"/iort/ask/{question}", f"/iort/answer/{question}"
answers = node.create_subscription(String, answered, lambda message: say(message.data), 10)
asking = node.create_publisher(String, asked, 10)
client = node.create_client(Trigger, asked)
executor = SingleThreadedExecutor()
executor.add_node(node)
spinning = threading.Thread(target=executor.spin)
spinning.start()
client.wait_for_service()
waiting = threading.Event()
while not (asking.get_subscription_count() and (alone or node.count_publishers(answered))):
    waiting.wait(0.01)  # rclpy has no event for it
say("found")
for line in sys.stdin:
    if line.strip() == "quit":
        break
    if line.strip():
        asking.publish(String(data=line.strip()))
    else:
        response = client.call(Trigger.Request())
        say(json.dumps([response.success, response.message]))
executor.shutdown()
spinning.join()
node.destroy_node()
rclpy.shutdown()
