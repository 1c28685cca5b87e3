"""A rospy subscriber: ``listener.py NAME TOPIC TYPE`` prints each message as a line of JSON."""

import json
import sys
import threading
import time

import roslib.message
import rospy

from iort_agent.ros import ros1_master
from testkit.publishing import say


def plain(value):
    if hasattr(value, "__slots__"):
        return {name: plain(getattr(value, name)) for name in value.__slots__}
    return [plain(item) for item in value] if isinstance(value, (list, tuple)) else value


name, topic, kind = sys.argv[1:4]
ros1_master.mend(f"/{name}")
rospy.init_node(name, disable_signals=True)
subscriber = rospy.Subscriber(
    topic,
    roslib.message.get_message_class(kind),
    lambda message: say(json.dumps([time.time(), plain(message)])),
    tcp_nodelay=True,
)
stop = threading.Event()


def listen():
    sys.stdin.readline()
    stop.set()


threading.Thread(target=listen, daemon=True).start()
while subscriber.get_num_connections() == 0 and not stop.wait(0.01):
    pass
say("connected")
stop.wait()
rospy.signal_shutdown("done")
