"""Hears every topic of the mixed robot, in a process of its own; a line a message: topic and base64."""

import base64
import sys
import threading

import rospy

from tests.ros.mixed_robot import TOPICS

turn = threading.Lock()


def say(message, topic):
    # Topics have threads of their own, whose lines must not run together.
    with turn:
        sys.stdout.write(f"{topic} {base64.b64encode(message._buff).decode()}\n")
        sys.stdout.flush()


rospy.init_node("feed", disable_signals=True, disable_rosout=True)
subscribers = [rospy.Subscriber(name, rospy.AnyMsg, say, callback_args=name) for name in TOPICS]
sys.stdin.readline()
rospy.signal_shutdown("done")
