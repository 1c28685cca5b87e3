"""rclpy and the message types that are installed on this machine. Nothing here is imported before it is
used."""

from __future__ import annotations

import importlib
from typing import Any

from iort_agent.errors import SourceError

_HELP = (
    "the agent's Python cannot import rclpy. ROS 2 has it for one Python only (Humble: 3.10, Jazzy: 3.12): "
    "`source /opt/ros/<distribution>/setup.bash`, then "
    "`/usr/bin/python3 -m venv --system-site-packages <folder>` and install the agent into that"
)


def rclpy() -> Any:
    """The module. Raises `SourceError` without it."""
    try:
        return importlib.import_module("rclpy")
    except ImportError as error:
        raise SourceError(f"{_HELP} ({error})") from error
