"""A topic of images as the camera that a driver sees by, on a real graph."""

from __future__ import annotations

from tests.ros.test_camera import camera_is_heard_while_somebody_looks
from tests.ros2.conftest import Graph


def test_a_topic_of_images_is_a_camera(graph: Graph) -> None:
    camera_is_heard_while_somebody_looks(graph)
