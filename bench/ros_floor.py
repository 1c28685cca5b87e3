"""The floor: a bare rospy subscriber that counts messages and does nothing with them."""

import sys

import rospy

count = 0


def take(_message: rospy.AnyMsg) -> None:
    """Count a message."""
    global count  # noqa: PLW0603 - as bare as it gets
    count += 1


rospy.init_node("bench_floor", disable_signals=True)
subscriber = rospy.Subscriber(sys.argv[1], rospy.AnyMsg, take, tcp_nodelay=True)
sys.stdin.readline()
print(count, flush=True)
