"""A rospy node that asks: ``caller.py NAME QUESTION`` prints each answer as a line of JSON.

An empty line of input calls the service, another one is published as the body on the topic of that name. With
``--alone``, nobody answers on a topic. The service's type is std_srvs' if that is installed; otherwise genpy
makes it from its text.
"""

import hashlib
import json
import sys
import threading

import rospy
from genpy.dynamic import generate_dynamic
from std_msgs.msg import String

from testkit.publishing import say

PARTS = {"Request": "", "Response": "bool success\nstring message"}


def trigger():
    try:
        from std_srvs.srv import Trigger
    except ImportError:
        made = {}
        for part, text in PARTS.items():
            kind = f"std_srvs/Trigger{part}"
            made[f"_{part.lower()}_class"] = generate_dynamic(kind, text)[kind]
        md5sum = hashlib.md5("".join(PARTS.values()).encode()).hexdigest()
        return type("Trigger", (), {"_type": "std_srvs/Trigger", "_md5sum": md5sum, **made})
    return Trigger


name, question = sys.argv[1:3]
alone = "--alone" in sys.argv
rospy.init_node(name, disable_signals=True)
answers = rospy.Subscriber(f"/iort/answer/{question}", String, lambda message: say(message.data))
asking = rospy.Publisher(f"/iort/ask/{question}", String, queue_size=10)
rospy.wait_for_service(f"/iort/ask/{question}", timeout=120)
call = rospy.ServiceProxy(f"/iort/ask/{question}", trigger())
connected = threading.Event()
while not (asking.get_num_connections() and (alone or answers.get_num_connections())):
    connected.wait(0.01)  # rospy has no event for it
say("found")
for line in sys.stdin:
    if line.strip() == "quit":
        break
    if line.strip():
        asking.publish(line.strip())
    else:
        response = call()
        say(json.dumps([response.success, response.message]))
rospy.signal_shutdown("done")
