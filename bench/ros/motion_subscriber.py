"""A ROS node that hears motion commands: each is a line with the time and the speed, as they arrive.

Usage: ``motion_subscriber.py TOPIC``, for geometry_msgs/Twist. The time is `time.monotonic`, which all
processes of a machine share; `CLOCK_REALTIME` follows it.
"""

from __future__ import annotations

import struct
import sys
import time
from typing import Any

import rospy


def _heard(message: Any) -> None:
    # Six doubles, of which linear.x is the first.
    speed = struct.unpack_from("<d", message._buff)[0]  # noqa: SLF001 - as rospy documents AnyMsg
    sys.stdout.write(f"{time.monotonic()} {time.time()} {speed}\n")
    sys.stdout.flush()


rospy.init_node("motion_subscriber", disable_signals=True)
rospy.Subscriber(sys.argv[1], rospy.AnyMsg, _heard, tcp_nodelay=True)
rospy.spin()
