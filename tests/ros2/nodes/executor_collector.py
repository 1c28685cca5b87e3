"""The collector, under an rclpy whose wait sets only its own executor can use: `... CONFIG.json`."""

import functools
import runpy

from rclpy.impl.implementation_singleton import rclpy_implementation

from tests.ros2.conftest import COLLECTOR

rclpy_implementation.WaitSet = functools.partial(rclpy_implementation.WaitSet)
runpy.run_path(str(COLLECTOR), run_name="__main__")
