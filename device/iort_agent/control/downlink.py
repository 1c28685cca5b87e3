"""The thread and the lifecycle of what passes between the broker and ROS: commands, peers, shares, asks."""

from __future__ import annotations

import logging
import threading
from pathlib import Path
from typing import Any, Callable, Iterable, Sequence

from iort_agent.common.state import ClockOffset
from iort_agent.common.threads import Supervised
from iort_agent.control import Bridge
from iort_agent.control.commands import Commands, Operator, Sight
from iort_agent.control.config import DownlinkConfig, ShareConfig
from iort_agent.control.guard import NODES, Guard
from iort_agent.control.peers import Peers, Shares
from iort_agent.control.questions import Asks, Questions
from iort_agent.errors import SourceError
from iort_agent.files.upload import Uploader, downloader
from iort_agent.mqtt.uplink import Link
from iort_agent.ros import Graph
from iort_agent.ros.ros1_node import DEFAULT_NODE

_log = logging.getLogger(__name__)

_IDLE_S = 1.0


class Downlink:
    """Made before the uplink starts. `start` begins, `halt` stops all motion, `close` ends.

    Raises `SourceError` for a ROS type that is not installed, `ConfigError` for a stop that does not fit its
    type.
    """

    def __init__(
        self,
        config: DownlinkConfig,
        share: Sequence[tuple[str, ShareConfig]],
        bridge: Bridge,
        *,
        boot: str,
        operator: Operator,
        guard: Guard | None = None,
        questions: Questions | None = None,
        sight: Sight | None = None,
    ) -> None:
        self._clock, self._bridge, self._guard = bridge.link.clock, bridge, guard
        self._wake, self._end = threading.Event(), threading.Event()
        self._thread = Supervised("downlink", self._run)
        wake = self._wake.set
        self._commands = Commands(config, bridge, operator=operator, guard=guard, wake=wake, sight=sight)
        self._peers = Peers(config, bridge)
        self._shares = Shares(share, bridge, boot=boot, wake=self._wake.set)
        self._asks = Asks(config.ask, bridge, questions) if questions is not None else None

    def start(self) -> None:
        """Join the ROS graph and begin."""
        self._bridge.graph.start()
        if self._guard is not None:
            self._guard.start()
        self._thread.start()
        if self._asks is not None:
            self._asks.start()

    def set_stopped(self, stopped: bool) -> None:  # noqa: FBT001 - a setting's value
        """Begin or release the emergency stop."""
        self._commands.set_stopped(stopped)

    def halt(self, *, keep_stop: bool = False) -> None:
        """Stop all motion, and let no further command pass. Stops are repeated until `close`; those of an
        emergency stop only with ``keep_stop``."""
        self._commands.halt(keep_stop=keep_stop)
        if self._asks is not None:
            self._asks.halt()
        self._wake.set()

    def close(self, *, keep_stop: bool = False) -> None:
        """Stop all motion, publish every repeated stop, and leave the ROS graph; with ``keep_stop``, leave an
        emergency stop to the guard."""
        self.halt(keep_stop=keep_stop)
        self._end.set()
        self._wake.set()
        if self._thread.is_alive():
            self._thread.join()
        if self._asks is not None:
            self._asks.close()
        while (due := self._commands.tick()) is not None and not self._commands.held():
            self._clock.wait(threading.Event(), max(0.0, due - self._clock.monotonic()))
        if self._guard is not None:
            self._guard.close(leave=self._commands.held())
        self._bridge.graph.close()

    def tick(self) -> float:
        """Publish the stops and shares that are due. Returns the seconds until the next ones are."""
        due = [at for at in (self._commands.tick(), self._shares.tick()) if at is not None]
        now = self._clock.monotonic()
        return max(0.0, min(due, default=now + _IDLE_S) - now)

    def report(self) -> dict[str, Any]:
        """The counts of everything that passed, and of everything that was rejected."""
        return {
            "commands": self._commands.report(),
            "fleet": self._peers.report(),
            "shared": self._shares.report(),
            **({"guard": guarded} if (guarded := self._commands.guarded()) is not None else {}),
            **({"asked": self._asks.report()} if self._asks is not None else {}),
            "refused": self._bridge.rejections.counts(),
            "waits": self.waits(),
        }

    def alarms(self) -> list[str]:
        """Why the robot takes no motion."""
        return self._commands.alarms()

    def waits(self) -> str | None:
        """What the ROS graph waits for; None if it does not wait."""
        return self._bridge.graph.waits()

    def _run(self) -> None:
        while not self._end.is_set():
            self._wake.clear()
            wait_s = self.tick()
            if not self._end.is_set():
                self._clock.wait(self._wake, min(wait_s, _IDLE_S))


def make_downlink(
    config: DownlinkConfig,
    share: Sequence[tuple[str, ShareConfig]],
    *,
    link: Link,
    boot: str,
    sources: Iterable[object],
    graph: Graph | None,
    offset: Callable[[], ClockOffset | None],
    operator: Operator,
    uploader: Uploader | None = None,
    root_ca: Path | None = None,
    queue: Path | None = None,
    sight: Sight | None = None,
) -> Downlink | None:
    """The downlink of a configuration that has one: in the ROS node of the sources, or in a ``graph`` that is
    no ROS graph if they need no node.

    Raises as `Downlink`, and `SourceError` without rospy or rclpy.
    """
    if not (config.cmd or config.fleet or config.ask or share):
        return None
    guard, ros = None, config.graph(sources)
    if graph is None or ros.node is not None:
        try:
            graph = node = NODES[ros.version](ros.node or DEFAULT_NODE, link.clock)
        except SourceError as error:
            raise SourceError(
                f"downlink and share need ROS {ros.version}; without it remove them from car.yaml: {error}"
            ) from error
        if config.moves():
            guard = Guard(node.base, config.motions(), link.clock, queue, ros=node.ros)
    questions = None
    if config.ask and uploader is not None:
        questions = Questions(link, uploader, download=downloader(root_ca), offset=offset)
    bridge = Bridge(link, graph, offset)
    return Downlink(
        config, share, bridge, boot=boot, operator=operator, guard=guard, questions=questions, sight=sight
    )
