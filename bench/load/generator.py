"""Many simulated robots in one process, each with its own certificate, session and record lane.

Its argument is a file with a `Load` as JSON. Writes one JSON object a line to standard output: progress, and
at the end what was sent. Run by `bench.sections.fleet`."""

from __future__ import annotations

import json
import os
import sys
import threading
import time
from concurrent.futures import Future
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from iort_contract.catalog.vesc import VESC_STREAM
from iort_contract.limits import Value
from iort_contract.messages.batch import Batch, encode_batch
from iort_contract.topics import record_topic
from testkit.car import simulated_drive
from testkit.mqtt import Robot
from testkit.waiting import reached

Columns = dict[str, list[Value]]
_SECOND_US = 1_000_000
# Laps are one second long; robots start at different ones.
_LAPS = 60
_SETTLE_S = 120.0


@dataclass(frozen=True)
class Load:
    """The robots, each with the folder of its keys, the duration and the rate."""

    robots: dict[str, str]
    namespace: str
    seconds: int
    rate_hz: int


class Car:
    """One robot, which sends batches of a second, numbered from 0."""

    def __init__(self, robot: Robot, load: Load, columns: list[Columns]) -> None:
        self.robot, self._columns, self._rate_hz = robot, columns, load.rate_hz
        self._topic = record_topic(robot.name, VESC_STREAM, load.namespace)
        self._boot, self._first_us = os.urandom(4).hex(), 0
        self.resent = 0
        self.sent_ms: list[int] = []
        self.ack_ms: list[float] = []

    def send(self) -> None:
        """Send the batch of the last second."""
        seq = len(self.sent_ms)
        # Like the agent's batches, a batch lies within one second of wall time.
        self._first_us = self._first_us or (time.time_ns() // 1_000_000_000 - 1) * _SECOND_US
        first_us = self._first_us + seq * _SECOND_US
        times = [first_us + i * _SECOND_US // self._rate_hz for i in range(self._rate_hz)]
        payload = encode_batch(Batch(self._boot, seq, times, self._columns[seq % _LAPS]))
        self.sent_ms.append(time.time_ns() // 1_000_000)
        self._publish(payload, time.monotonic())

    def _publish(self, payload: bytes, began: float) -> None:
        def done(future: Future[Any]) -> None:
            if future.exception() is None and future.result().puback.reason_code == 0:
                self.ack_ms.append((time.monotonic() - began) * 1000)
            else:
                # Not from here: the client's own thread must not wait.
                self.resent += 1
                threading.Timer(1.0, self._publish, (payload, began)).start()

        self.robot.send(self._topic, payload).add_done_callback(done)


def laps(rate_hz: int) -> list[Columns]:
    """Return a minute of a simulated car, split into seconds."""
    samples = simulated_drive(_LAPS * rate_hz, rate_hz=rate_hz)
    seconds = [samples[i : i + rate_hz] for i in range(0, len(samples), rate_hz)]
    return [{name: [sample[name] for sample in second] for name in second[0]} for second in seconds]


def drive(load: Load) -> dict[str, Any]:
    """Connect every robot; each sends one batch a second at its own moment; wait for the end.

    Returns resent batches, lost sessions, ms to the acknowledgements, and by robot the times at which its
    batches left, in ms since the epoch.
    """
    seconds, cars = laps(load.rate_hz), list[Car]()
    with ExitStack() as stack:
        # One after the other, like a fleet that is switched on by hand.
        for i, folder in enumerate(load.robots.values()):
            robot = stack.enter_context(Robot(Path(folder))).online()
            cars.append(Car(robot, load, seconds[i % _LAPS :] + seconds[: i % _LAPS]))
        _say(connected=len(cars), pid=os.getpid())
        pause, began = threading.Event(), time.monotonic() + 0.1
        for second in range(load.seconds):
            for i, car in enumerate(cars):
                pause.wait(max(0.0, began + second + i / len(cars) - time.monotonic()))
                car.send()
            _say(second=second + 1)
        reached(lambda: all(len(car.ack_ms) >= load.seconds for car in cars), within_s=_SETTLE_S)
        lost = sum(car.robot.lost.is_set() for car in cars)
    return {
        "resent": sum(car.resent for car in cars),
        "lost_sessions": lost,
        "ack_ms": [round(ms, 3) for car in cars for ms in car.ack_ms],
        "sent_ms": {car.robot.name: car.sent_ms for car in cars},
    }


def _say(**what: Any) -> None:
    print(json.dumps(what), flush=True)


if __name__ == "__main__":
    _say(sent=drive(Load(**json.loads(Path(sys.argv[1]).read_text()))))
