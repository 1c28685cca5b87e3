"""The floor: a bare rospy subscriber of some topics that counts messages and does nothing with them."""

import sys

import rospy

count = 0


def take(_message: rospy.AnyMsg) -> None:
    """Count a message."""
    global count  # noqa: PLW0603 - as bare as it gets
    count += 1


rospy.init_node("bench_floor", disable_signals=True)
subscribers = [rospy.Subscriber(topic, rospy.AnyMsg, take, tcp_nodelay=True) for topic in sys.argv[1:]]
sys.stdin.readline()
print(count, flush=True)
