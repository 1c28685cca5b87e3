"""Publishes VescStateStamped at a rate with time stamps of now; runs under a Python with rospy.

python -m bench.ros.publisher TOPIC RATE_HZ COUNT
"""

import sys
import threading
import time

import genpy.dynamic
import rospy

from bench.ros.vesc_message import DEFINITION, FIELDS, TYPE, values


def main() -> None:
    """Wait for two subscribers, the agent and the bare one, then publish."""
    topic, rate_hz, count = sys.argv[1], float(sys.argv[2]), int(sys.argv[3])
    kind = genpy.dynamic.generate_dynamic(TYPE, DEFINITION)[TYPE]
    rospy.init_node("bench_publisher", disable_signals=True)
    publisher = rospy.Publisher(topic, kind, queue_size=2000, tcp_nodelay=True)
    pause = threading.Event()
    while publisher.get_num_connections() < 2:
        pause.wait(0.01)
    print("ready", flush=True)
    sys.stdin.readline()
    message = kind()
    began = time.monotonic()
    for i in range(count):
        ahead = began + i / rate_hz - time.monotonic()
        if ahead > 0:
            pause.wait(ahead)
        for name, value in zip(FIELDS, values(i), strict=True):
            setattr(message.state, name, value)
        message.header.stamp = genpy.Time.from_sec(time.time())
        publisher.publish(message)
    print("done", flush=True)
    sys.stdin.readline()


main()
