"""A ROS node that hears motion commands: each is a line with the time and the speed, as they arrive.

Usage: ``motion_subscriber.py TOPIC``, for geometry_msgs/Twist. The time is `time.monotonic`, which all
processes of a machine share; `CLOCK_REALTIME` follows it.
"""

from __future__ import annotations

import sys
import time
from typing import Any

import rospy
from geometry_msgs.msg import Twist


def _heard(message: Any) -> None:
    sys.stdout.write(f"{time.monotonic()} {time.time()} {message.linear.x}\n")
    sys.stdout.flush()


rospy.init_node("motion_subscriber", disable_signals=True)
rospy.Subscriber(sys.argv[1], Twist, _heard, tcp_nodelay=True)
rospy.spin()
