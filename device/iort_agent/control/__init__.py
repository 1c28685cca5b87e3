"""What the robot receives: commands, messages of other robots and the operator's settings. It uses lanes."""

from __future__ import annotations

import logging
from typing import Callable

from iort_agent.common.logs import ThrottledLog
from iort_agent.common.state import ClockOffset
from iort_agent.mqtt.uplink import Link
from iort_agent.ros import Graph

_log = logging.getLogger(__name__)


class Bridge:
    """The two sides that commands, peers and questions connect: the broker and the ROS graph.

    ``offset`` returns the cloud's clock minus ours, if it is known well enough.
    """

    def __init__(self, link: Link, graph: Graph, offset: Callable[[], ClockOffset | None]) -> None:
        self.link, self.graph, self.offset = link, graph, offset
        self.rejections = ThrottledLog(_log, link.clock)

    def offset_us(self) -> int | None:
        """The offset in microseconds."""
        return offset_us(self.offset())

    def reject(self, what: str, reason: str, why: str) -> None:
        """Count a rejected message, and log it unless one like it was logged less than a minute ago."""
        self.rejections.warn(f"{what} {reason}", f"{what}: rejected: {why}")


def offset_us(offset: ClockOffset | None) -> int | None:
    """A clock offset in microseconds, if it is known."""
    return round(offset.offset_ms * 1000) if offset is not None else None
