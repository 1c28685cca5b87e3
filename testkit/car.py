"""Runs the installed agent in its own process, to drive a robot for the bench."""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

from typing_extensions import Self

from iort_agent.common.state import ClockOffset
from iort_agent.common.threads import SystemClock
from iort_agent.config import load_config
from iort_agent.control.questions import Questions
from iort_agent.files.upload import downloader, make_uploader
from iort_agent.lanes import PingConfig
from iort_agent.lanes.pings import Pings
from iort_agent.mqtt.rate_limiter import RateLimiter
from iort_agent.mqtt.uplink import Link
from iort_agent.runtime import make_uplink
from iort_agent.sources.sim import Sensors
from iort_agent.sources.sim.vehicle import Vehicle, VehicleConfig
from iort_contract.catalog.streams import POSE_STREAM, RTT_FIELDS
from iort_contract.catalog.vesc import VESC_STREAM
from iort_contract.limits import Value
from iort_contract.topics import BROKER, PING, PONG, build_topic
from iort_station.fleet.robots import Bundle
from testkit import ROOT
from testkit.waiting import InstrumentError

_COMMAND = str(Path(sys.executable).parent / "iort-agent")
_END_S = 120.0


class AgentProcess:
    """The agent of a bundle; it runs from `__enter__` to `__exit__`, which stops it in good order."""

    def __init__(self, bundle: Bundle, *, drain_s: float = 60.0) -> None:
        self.robot = bundle.robot
        self._bundle = bundle
        self._report = bundle.folder / "report.json"
        self._drain_s = drain_s
        self.process: subprocess.Popen[bytes]

    def __enter__(self) -> Self:
        self._log = tempfile.TemporaryFile()
        self._start()
        return self

    def kill(self) -> int:
        """SIGKILL, and a new start in the same folder; returns the time of the kill in us since the epoch."""
        killed_us = time.time_ns() // 1000
        self.process.kill()
        self.process.wait()
        self._start()
        return killed_us

    def _start(self) -> None:
        self.started_us = time.time_ns() // 1000
        config = ["--config", str(self._bundle.config), "--report", str(self._report)]
        self.process = subprocess.Popen(
            [_COMMAND, "run", *config, "--drain-s", str(self._drain_s)],
            cwd=ROOT,
            stdout=subprocess.DEVNULL,
            stderr=self._log,
        )

    def __exit__(self, *_: object) -> None:
        self.process.terminate()
        try:
            self.process.wait(_END_S)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()
        self._log.close()

    def finished(self) -> dict[str, Any]:
        """Wait for the end of its sources and the last delivery; return the agent's report."""
        status = self.process.wait(_END_S + self._drain_s)
        if status:
            self._log.seek(0)
            raise InstrumentError(f"the agent ended with status {status}: {self._log.read()[-800:]!r}")
        written: dict[str, Any] = json.loads(self._report.read_text())
        return written


RATE_HZ = 50
# With larger steps the driver swerves.
_STEP_S = 0.02


def simulated_drive(
    count: int, *, rate_hz: float = RATE_HZ, after_s: float = 0.0, stream: str = VESC_STREAM
) -> list[dict[str, Value]]:
    """Return so many samples of the same drive, of its VESC or its pose, from ``after_s`` on."""
    vehicle = Vehicle(VehicleConfig(), seed=1)
    for _ in range(round(after_s / _STEP_S)):
        vehicle.step(_STEP_S)
    samples, measured = [], Sensors(vehicle, seed=1)
    for _ in range(count):
        vehicle.step(min(_STEP_S, 1 / rate_hz))
        samples.append(measured.pose() if stream == POSE_STREAM else measured.vesc())
    return samples


_WAIT_S, _CONNECT_S = 60.0, 30.0
# Bytes of a ping besides its padding, approximately.
ENVELOPE = 60
# Asks by name and body; raises `AskError`.
Ask = Callable[[str, Mapping[str, Any]], Mapping[str, Any]]


@contextmanager
def asking(bundle: Bundle) -> Iterator[Ask]:
    """A connected robot that asks. Its clock is the cloud's."""
    with Connected(bundle) as robot:
        link, config = robot.link(), robot.config
        uploader = make_uploader(link, root_ca=config.root_ca, rate_kb_s=0)
        offset = ClockOffset(0.0, 1.0)
        questions = Questions(link, uploader, download=downloader(config.root_ca), offset=lambda: offset)
        deadline, pause = time.monotonic() + _WAIT_S, threading.Event()
        while not questions.ready():
            if time.monotonic() > deadline:
                raise InstrumentError(f"{config.robot} did not hear its answers within {_WAIT_S:g} s")
            pause.wait(0.02)  # the uplink gives no notice of it
        yield lambda name, body: questions.ask(name, body, _WAIT_S)


class Connected:
    """The agent's uplink of a bundle, connected from `__enter__` to `__exit__`, to ``port`` if given."""

    def __init__(self, bundle: Bundle, port: int | None = None) -> None:
        self.config = load_config(bundle.config)
        self.clock = SystemClock()
        self.lost = 0
        self.uplink = make_uplink(replace(self.config, port=port or self.config.port), self.clock)

    def __enter__(self) -> Self:
        connected = threading.Event()
        self.uplink.on_connection(lambda up: connected.set() if up else None)
        self.uplink.start()
        if not connected.wait(_CONNECT_S):
            raise InstrumentError(f"{self.config.robot} was not connected within {_CONNECT_S:.0f} s")
        return self

    def __exit__(self, *_: object) -> None:
        self.uplink.stop(5.0)

    def link(self) -> Link:
        """The robot's link, without the agent's limit of its rate."""
        limiter = RateLimiter(self.clock, publishes_per_s=1e6, bytes_per_s=1e9)
        return Link(self.config.robot, self.config.namespace, self.uplink, self.clock, limiter)

    def measure(self, path: str, rate_hz: float, size: int, begins: float, seconds: float) -> list[float]:
        """Round trips over a path from then on, in milliseconds, by the agent's own pings."""
        trips: list[float] = []

        def emit(_stream: str, _t_us: int, values: Any) -> None:
            value: Value = values[RTT_FIELDS[path]]
            if isinstance(value, (int, float)):
                trips.append(float(value))

        pings = Pings(
            self.link(),
            PingConfig(rate_hz, (path,), max(0, size - ENVELOPE)),
            emit=emit,
            on_stamp=lambda _sent, _received, _stamp_ms: None,
        )
        stop = threading.Event()
        lane = PING if path == BROKER else PONG
        answers = build_topic(lane, self.config.robot, path, self.config.namespace)
        while not self.uplink.subscribed(answers):
            stop.wait(0.02)
        stop.wait(max(0.0, begins - time.perf_counter()))
        runner = threading.Thread(target=pings.run, args=(stop,), daemon=True)
        runner.start()
        stop.wait(seconds)
        stop.set()
        pings.wake()
        runner.join()
        pings.close(5.0)
        self.lost += pings.report()[path].lost
        return trips
