"""A car to drive by hand from a browser: an embedded cloud, the page's server, and a ROS graph.

The graph has the agent and a subscriber of its motion commands. A proxy is between browser and broker.
"""

from __future__ import annotations

import os
import signal
import subprocess
import threading
import time
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

from typing_extensions import Self

from bench.load.tries import Heard
from iort_station.fleet import robots
from iort_station.page import answers as control
from iort_station.page import motion
from iort_station.page.answers import actions, answers
from iort_station.page.server import PageServer
from local.cloud import EmbeddedCloud
from local.network.proxy import Proxy
from testkit.ros import RosGraph
from testkit.waiting import InstrumentError

ROBOT, TOPIC = "driven", "/cmd_vel"
LEASE_S = 0.5
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
                actions=control.keyed_actions(self.cloud),
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
