"""A car to drive by hand from a browser: an embedded cloud, the page's server, and a ROS graph.

The graph has the agent and a subscriber of its motion commands. A proxy is between browser and broker."""

from __future__ import annotations

import os
import signal
import subprocess
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import NamedTuple

from typing_extensions import Self

from iort_contract.catalog.streams import DRIVE_STREAM
from iort_station import data
from iort_station.cloud import Cloud
from iort_station.fleet import robots
from iort_station.page import answers as control
from iort_station.page import motion
from iort_station.page.answers import actions, answers
from iort_station.page.server import PageServer
from local.cloud import EmbeddedCloud
from local.network.proxy import Proxy
from testkit.ros import RosGraph
from testkit.waiting import InstrumentError

# What is told of a try that failed: from before the failure until after the stop.
_BEFORE_S, _AFTER_S = 1.0, 2.0
# The record may lag behind by a batch.
_MARGIN_S = 5.0


class Heard(NamedTuple):
    """A motion command at the ROS subscriber: `time.monotonic`, `time.time`, and the speed."""

    at: float
    wall_s: float
    speed: float


@dataclass(frozen=True)
class Try:
    """A failure at ``failed`` (its speed is 0), and what the ROS subscriber heard of the car around it."""

    failure: str
    number: int
    failed: Heard
    heard: Sequence[Heard] = field(repr=False)
    lease_s: float

    @property
    def driven(self) -> bool:
        """Whether the car was driven when it failed, or after; otherwise it is no try."""
        before = [one.speed for one in self.heard if one.at <= self.failed.at]
        return before[-1:] != [0.0] or any(one.at > self.failed.at and one.speed for one in self.heard)

    @property
    def first(self) -> Heard | None:
        """The first stop after the failure."""
        return next((one for one in self.heard if one.at > self.failed.at and one.speed == 0), None)

    @property
    def late_s(self) -> float | None:
        """From the failure, or the last motion if that was later, to the stop after it; None without one."""
        last = max((one.at for one in self.heard if one.speed != 0), default=self.failed.at)
        stop = next((one for one in self.heard if one.at > max(last, self.failed.at)), None)
        return None if stop is None else stop.at - max(last, self.failed.at)

    @property
    def moved_again_s(self) -> float | None:
        """From the first stop after the failure to the last motion after it; None if there was none."""
        first = self.first
        after = [one.at for one in self.heard if first and one.at > first.at and one.speed != 0]
        return after[-1] - first.at if first is not None and after else None

    @property
    def why(self) -> str:
        """Why the try failed; empty if it did not."""
        if self.late_s is None:
            return "no stop"
        reasons = []
        if self.late_s > self.lease_s:
            reasons.append(f"the stop came {self.late_s * 1000:.0f} ms after the last motion or the failure")
        if self.moved_again_s is not None:
            reasons.append(f"a motion came {self.moved_again_s * 1000:.0f} ms after the first stop")
        return "; ".join(reasons)

    def lines(self, cloud: Cloud, robot: str) -> Iterator[str]:
        """What happened, in ms from the failure: the commands as the car recorded them, and as ROS heard
        them."""
        told = [(0.0, f"{self.failure}: {self.why}")]
        told += [(one.wall_s - self.failed.wall_s, f"ROS heard {one.speed:g} m/s") for one in self.heard]
        since, until = (self.failed.wall_s + by for by in (-_BEFORE_S - _MARGIN_S, _AFTER_S + _MARGIN_S))
        recorded = data.query(cloud, robot, DRIVE_STREAM, round(since * 1e6), round(until * 1e6))
        columns = recorded.columns
        for i, t_us in enumerate(recorded.times_us.tolist()):
            at_s, sent_s = (us / 1e6 - self.failed.wall_s for us in (t_us, columns["sent_us"][i]))
            outcome, seq, left = (columns[name][i] for name in ("outcome", "seq", "lease_left_ms"))
            command = f"command {seq:.0f} of {columns['session'][i][:4]}, {columns['speed'][i]} m/s"
            times = f"sent at {sent_s * 1000:.0f} ms, lease left {left:.0f} ms"
            told.append((at_s, f"car: {outcome}, {command}, {times}"))
        for at_s, text in sorted(told):
            if -_BEFORE_S <= at_s <= _AFTER_S:
                yield f"{at_s * 1000:8.0f} ms  {text}"


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
