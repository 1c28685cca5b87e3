"""Subscribes to every topic of the mixed robot, in its own process; prints topic and base64 per message."""

import base64
import sys
import threading

import rospy

from iort_agent.ros1 import master
from tests.ros.mixed.robot import TOPICS

turn = threading.Lock()


def say(message, topic):
    # Topics have their own threads, whose lines must not mix.
    with turn:
        sys.stdout.write(f"{topic} {base64.b64encode(message._buff).decode()}\n")
        sys.stdout.flush()


master.mend("/feed")
rospy.init_node("feed", disable_signals=True, disable_rosout=True)
subscribers = [rospy.Subscriber(name, rospy.AnyMsg, say, callback_args=name) for name in TOPICS]
sys.stdin.readline()
rospy.signal_shutdown("done")
