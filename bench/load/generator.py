"""Many simulated robots in one process, each with its own certificate, session and record lane.

Its argument is a file with a `Load` as JSON. Writes one JSON object a line to standard output: progress, and
at the end what was sent. Run by `bench.sections.fleet`."""

from __future__ import annotations

import json
import os
import sys
import threading
import time
from collections.abc import Sequence
from concurrent.futures import Future
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from awscrt import mqtt5
from awsiot import mqtt5_client_builder

from iort_contract.catalog.vesc import VESC_STREAM
from iort_contract.limits import Value
from iort_contract.messages.batch import Batch, encode_batch
from iort_contract.topics import record_topic
from testkit.car import simulated_drive

Columns = dict[str, list[Value]]
_SECOND_US = 1_000_000
# Laps are one second long; robots start at different ones.
_LAPS = 60
_CONNECT_S = 120.0
_SETTLE_S = 120.0


@dataclass(frozen=True)
class Load:
    """The robots, each with the folder of its keys, the duration, the rate and the address of the broker."""

    robots: dict[str, str]
    namespace: str
    host: str
    port: int
    seconds: int
    rate_hz: int


class Robot:
    """One robot with its own session; it sends batches of a second, numbered from 0."""

    def __init__(
        self, name: str, folder: Path, load: Load, columns: Sequence[dict[str, list[Value]]]
    ) -> None:
        self.name = name
        self._columns, self._namespace = columns, load.namespace
        self._topic = record_topic(name, VESC_STREAM, load.namespace)
        self._boot, self._first_us, self._rate_hz = os.urandom(4).hex(), 0, load.rate_hz
        self.connected = threading.Event()
        self.lost = self.resent = 0
        self.sent_ms: list[int] = []
        self.ack_ms: list[float] = []
        self.acknowledged: set[int] = set()
        self.client = mqtt5_client_builder.mtls_from_path(
            str(folder / "certificate.pem"),
            str(folder / "private.key"),
            endpoint=load.host,
            port=load.port,
            ca_filepath=str(folder / "root-ca.pem"),
            client_id=name,
            keep_alive_interval_sec=60,
            ack_timeout_sec=60,
            min_reconnect_delay_ms=500,
            max_reconnect_delay_ms=5_000,
            on_lifecycle_connection_success=lambda _: self.connected.set(),
            on_lifecycle_disconnection=self._disconnected,
        )

    def _disconnected(self, _: Any) -> None:
        self.lost += 1

    def send(self) -> None:
        """Send the batch of the last second."""
        seq = len(self.sent_ms)
        # Like the agent's batches, a batch lies within one second of wall time.
        self._first_us = self._first_us or (time.time_ns() // 1_000_000_000 - 1) * _SECOND_US
        first_us = self._first_us + seq * _SECOND_US
        times = [first_us + i * _SECOND_US // self._rate_hz for i in range(self._rate_hz)]
        batch = Batch(self._boot, seq, times, self._columns[seq % len(self._columns)])
        payload = encode_batch(batch)
        self.sent_ms.append(time.time_ns() // 1_000_000)
        self._publish(seq, payload, time.monotonic())

    def _publish(self, seq: int, payload: bytes, began: float) -> None:
        packet = mqtt5.PublishPacket(topic=self._topic, payload=payload, qos=mqtt5.QoS.AT_LEAST_ONCE)

        def done(future: Future[Any]) -> None:
            if future.exception() is None and future.result().puback.reason_code == 0:
                self.acknowledged.add(seq)
                self.ack_ms.append((time.monotonic() - began) * 1000)
            else:
                # Not from here: the client's own thread must not wait.
                self.resent += 1
                threading.Timer(1.0, self._publish, (seq, payload, began)).start()

        self.client.publish(packet).add_done_callback(done)


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
    seconds = laps(load.rate_hz)
    robots = [
        Robot(name, Path(folder), load, seconds[i % _LAPS :] + seconds[: i % _LAPS])
        for i, (name, folder) in enumerate(load.robots.items())
    ]
    for i, robot in enumerate(robots):
        robot.client.start()
        # Connect in small groups, like a fleet that is switched on by hand.
        if i % 10 == 9:
            _connected(robots[i - 9 : i + 1])
            _say(connected=i + 1)
    _connected(robots)
    _say(connected=len(robots), pid=os.getpid())
    pause, began = threading.Event(), time.monotonic() + 0.1
    for second in range(load.seconds):
        for i, robot in enumerate(robots):
            due = began + second + i / len(robots)
            pause.wait(max(0.0, due - time.monotonic()))
            robot.send()
        _say(second=second + 1)
    until = time.monotonic() + _SETTLE_S
    while any(len(r.acknowledged) < len(r.sent_ms) for r in robots) and time.monotonic() < until:
        pause.wait(0.1)
    for robot in robots:
        robot.client.stop()
    return {
        "resent": sum(robot.resent for robot in robots),
        "lost_sessions": sum(robot.lost for robot in robots),
        "ack_ms": [round(ms, 3) for robot in robots for ms in robot.ack_ms],
        "sent_ms": {robot.name: robot.sent_ms for robot in robots},
    }


def _connected(robots: Sequence[Robot]) -> None:
    deadline = time.monotonic() + _CONNECT_S
    for robot in robots:
        if not robot.connected.wait(max(0.0, deadline - time.monotonic())):
            sys.exit(f"{robot.name} was not connected within {_CONNECT_S:.0f} s")


def _say(**what: Any) -> None:
    print(json.dumps(what), flush=True)


def main() -> None:
    """Drive the load of the argument."""
    _say(sent=drive(Load(**json.loads(Path(sys.argv[1]).read_text()))))


if __name__ == "__main__":
    main()
