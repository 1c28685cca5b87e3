"""A car to drive by hand from a browser: an embedded cloud, the page's server, and a ROS graph.

The graph has the agent and a subscriber of its motion commands. A proxy is between browser and broker."""

from __future__ import annotations

import os
import signal
import subprocess
import threading
import time
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

from typing_extensions import Self

from iort_station.fleet import robots
from iort_station.page import motion
from iort_station.page.answers import actions, answers, keyed_actions
from iort_station.page.server import PageServer
from local.cloud import EmbeddedCloud
from testkit.proxy import Proxy
from testkit.ros import RosGraph
from testkit.waiting import InstrumentError

LEASE_S = 0.5


class Heard(NamedTuple):
    """A motion command at the ROS subscriber: `time.monotonic`, `time.time`, and the speed."""

    at: float
    wall_s: float
    speed: float


@dataclass(frozen=True)
class Try:
    """A failure at ``failed_at``, and what the ROS subscriber heard of the car around it."""

    failed_at: float
    heard: Sequence[Heard]

    @property
    def driven(self) -> bool:
        """Whether the car was driven when it failed, or after; otherwise it is no try."""
        before = [one.speed for one in self.heard if one.at <= self.failed_at]
        return before[-1:] != [0.0] or any(one.at > self.failed_at and one.speed for one in self.heard)

    @property
    def first(self) -> Heard | None:
        """The first stop after the failure."""
        return next((one for one in self.heard if one.at > self.failed_at and one.speed == 0), None)

    @property
    def late_s(self) -> float | None:
        """From the failure, or the last motion if that was later, to the stop after it; None without one."""
        last = max((one.at for one in self.heard if one.speed != 0), default=self.failed_at)
        stop = next((one for one in self.heard if one.at > max(last, self.failed_at)), None)
        return None if stop is None else stop.at - max(last, self.failed_at)

    @property
    def why(self) -> str:
        """Why the try failed; empty if it did not."""
        first, late_s = self.first, self.late_s
        if first is None or late_s is None:
            return "no stop"
        reasons = []
        if late_s > LEASE_S:
            reasons.append(f"the stop came {late_s * 1000:.0f} ms after the last motion or the failure")
        if again := [one.at - first.at for one in self.heard if one.at > first.at and one.speed != 0]:
            reasons.append(f"a motion came {again[-1] * 1000:.0f} ms after the first stop")
        return "; ".join(reasons)

    def story(self) -> str:
        """The commands that the ROS subscriber heard, in ms from the failure."""
        told = (f"{(one.at - self.failed_at) * 1000:.0f} ms {one.speed:g} m/s" for one in self.heard)
        return f"{self.why}: {', '.join(told)}"


ROBOT, TOPIC = "driven", "/cmd_vel"
_TWIST = {"linear": {"x": 0.0}, "angular": {"z": 0.0}}
SETTINGS = {
    # The simulated car has fresh samples; beside the ros1 source its commands go to ROS.
    "sources": [
        {"type": "sim", "stream": "vesc", "rate_hz": 50},
        {"type": "ros1", "topics": {"/odom": {"stream": "odom", "time": "arrival"}}},
    ],
    "ping": {"rate_hz": 5},
    "downlink": {
        "cmd": {
            "drive": {
                "topic": TOPIC,
                "type": "geometry_msgs/Twist",
                "partial": True,
                "motion": {"lease_s": LEASE_S, "stop": _TWIST},
            }
        },
        "drive": {"command": "drive", "speed": "linear.x", "steering": "angular.z"},
    },
}


class Course:
    """Everything from `__enter__` to `__exit__`. ``agent`` is the agent's process."""

    def __init__(self, python: str, folder: Path) -> None:
        self._python, self._folder = python, folder
        self._exit = ExitStack()
        self._news = threading.Condition()
        self.heard: list[Heard] = []
        self.agent: subprocess.Popen[str]

    def __enter__(self) -> Self:
        with ExitStack() as stack:
            embedded = stack.enter_context(EmbeddedCloud(self._folder / "local"))
            port = int(embedded.cloud.websocket_url.split(":")[2].partition("/")[0])
            self.proxy = stack.enter_context(Proxy("127.0.0.1", port))
            self.cloud = replace(embedded.cloud, websocket=f"ws://127.0.0.1:{self.proxy.port}/mqtt")
            self._graph = stack.enter_context(RosGraph(self._python, self._folder))
            listener = self._graph.start("bench.ros.motion_subscriber", TOPIC)
            threading.Thread(target=self._listen, args=(listener,), daemon=True).start()
            self._bundle = robots.add(embedded.cloud, ROBOT, out=self._folder, settings=SETTINGS)
            self.start_agent()
            server = PageServer(
                namespace=self.cloud.namespace,
                **motion.reaching(self.cloud, "iot"),
                answers=answers(self.cloud),
                open_actions=actions(self.cloud),
                actions=keyed_actions(self.cloud),
            )
            self.server = stack.enter_context(server)
            self._exit = stack.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        self._exit.close()

    def start_agent(self) -> None:
        """Start the agent, after the last one has ended."""
        self.agent = self._graph.start("iort_agent.cli", "run", "--config", self._bundle.config)

    def kill_agent(self) -> None:
        """End the agent as a power cut does; its guard lives on."""
        os.kill(self.agent.pid, signal.SIGKILL)
        self.agent.wait()

    def wait(self, after: float, *, moving: bool, within_s: float) -> Heard:
        """The first command after a time that moves the car, or that stops it; raises `InstrumentError`."""

        def found() -> Heard | None:
            return next((one for one in self.heard if one.at > after and (one.speed != 0) == moving), None)

        with self._news:
            if (one := self._news.wait_for(found, within_s)) is None:
                raise InstrumentError(f"no {'motion' if moving else 'stop'} within {within_s:g} s")
            return one

    def last_motion(self) -> Heard:
        return next(one for one in reversed(self.heard) if one.speed != 0)

    def quiet(self, seconds: float) -> None:
        """Wait until no command has come for so long."""
        while self.heard and (left := self.heard[-1].at + seconds - time.monotonic()) > 0:
            # The absence of a message has no event.
            time.sleep(left)

    def _listen(self, listener: subprocess.Popen[str]) -> None:
        assert listener.stdout is not None
        for line in listener.stdout:
            with self._news:
                self.heard.append(Heard(*map(float, line.split())))
                self._news.notify_all()
