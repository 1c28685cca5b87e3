"""A topic as the agent's camera alone: `camera.py ROS TOPIC`. Each picture is a line of JSON: its number,
its age in milliseconds, its size, and the three values of a pixel (Y, U, V). Each input line closes the
camera, or opens it again; the end of the input ends it."""

import json
import sys
import threading
from pathlib import Path

from iort_agent.common.schema import Place, load
from iort_agent.common.threads import SystemClock
from iort_agent.control.guard import NODES
from iort_agent.video.config import VideoConfig
from iort_agent.video.ros_camera import RosCamera
from testkit.publishing import say

version, topic = int(sys.argv[1]), sys.argv[2]
settings = {"source": {"type": "topic", "topic": topic}, "width": 128, "height": 96, "rate_hz": 10}
config = load(VideoConfig, settings, Place(Path("car.yaml")))
clock = SystemClock()
graph = NODES[version]("watcher", clock)
graph.start()
camera = RosCamera(graph, topic, config, clock)


def watch(stop):
    """Read until ``stop``."""
    camera.open()
    number = 0
    while not stop.is_set():
        number += 1
        frame = camera.read(number, stop)
        if frame is not None:
            picture = frame.picture
            middle = [plane.line_size * (plane.height // 2) + plane.width // 2 for plane in picture.planes]
            pixel = [bytes(plane)[at] for plane, at in zip(picture.planes, middle, strict=False)]
            age_ms = (clock.monotonic() - frame.monotonic) * 1000
            say(json.dumps([frame.number, age_ms, picture.width, picture.height, pixel]))
    camera.close()
    say("closed")


watching = True
while watching:
    stop = threading.Event()
    thread = threading.Thread(target=watch, args=(stop,))
    thread.start()
    watching = bool(sys.stdin.readline())
    stop.set()
    thread.join()
    watching = watching and bool(sys.stdin.readline())
graph.close()
