"""A topic of images as the camera that a driver sees by, on a real graph."""

from __future__ import annotations

import json
from typing import Any

from tests.ros.process import Process

# Of blue, by ITU-R BT.601 in its narrow range: within rounding.
BLUE = (41, 240, 110)


def start(graph: Any, script: str, *arguments: object) -> Process:
    """Run one of nodes/ of either ROS."""
    module = f"tests.ros.nodes.{script}"
    process: Process = graph.module(module, graph.ros, *arguments)
    return process


def camera_is_heard_while_somebody_looks(graph: Any) -> None:
    """What holds in either ROS."""
    publisher = start(graph, "images", "/camera/image_raw")
    publisher.until(lambda: "subscribers 0" in publisher.lines, "publisher")
    camera = start(graph, "camera", "/camera/image_raw")

    def pictures() -> list[Any]:
        return [json.loads(line) for line in camera.lines if line.startswith("[")]

    camera.until(lambda: len(pictures()) >= 5, "pictures")
    for number, (counted, age_ms, width, height, pixel) in enumerate(pictures(), 1):
        assert counted == number
        # By its stamp; a picture from the future would be younger than 0.
        assert age_ms > 0
        assert (width, height) == (128, 96)
        assert all(abs(value - blue) <= 3 for value, blue in zip(pixel, BLUE, strict=True)), pixel
    publisher.until(lambda: "subscribers 1" in publisher.lines, "subscription")
    camera.say("close")
    camera.until(lambda: "closed" in camera.lines, "end")
    publisher.until(lambda: publisher.lines[-1] == "subscribers 0", "end of the subscription")
    before = len(pictures())
    camera.say("open")
    camera.until(lambda: len(pictures()) > before, "pictures again")


def test_a_topic_of_images_is_a_camera(graph: Any) -> None:
    camera_is_heard_while_somebody_looks(graph)
