"""Measures the delay from ROS publish to an MQTT subscriber over the live lane, through mosquitto.

The floor is a bare rospy subscriber that hands the same messages, at the same rate, to a bare MQTT client.
Both use the same topic, broker, TLS and subscriber at the same time.
"""

from __future__ import annotations

import struct
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

from bench.floors.mosquitto import ROBOT, Mosquitto
from bench.meters.watcher import subscribed
from bench.ros.mixed_robot import CORE
from iort_contract.catalog.vesc import VESC_STREAM
from iort_contract.limits import LIVE_MAX_RATE_HZ
from iort_contract.messages.live import decode_live
from iort_contract.topics import LIVE, build_topic, live_topic
from local.figures import Spread
from testkit.ros import RosGraph

TOPIC = "/sensors/core"
_FLOOR = "bench/floor"
# A live message goes one way or the other; unlike AWS IoT, mosquitto delivers both.
_AGENT = (build_topic(LIVE, ROBOT, VESC_STREAM), live_topic(ROBOT, VESC_STREAM))
_WARM_UP_S = 3


@dataclass(frozen=True)
class Lane:
    """The delays at one rate, of the agent and of the floor."""

    rate_hz: int
    agent_ms: Spread
    floor_ms: Spread


def measure(program: str, python: str, rate_hz: int, seconds: int) -> Lane:
    """Run both side by side. Raises `RosError` if one of the processes stops."""
    agent_ms: list[float] = []
    floor_ms: list[float] = []

    def take(topic: str, payload: bytes) -> None:
        now_us = time.time_ns() // 1000
        if topic == _FLOOR:
            floor_ms.append((now_us - _stamp_us(payload)) / 1000)
        else:
            agent_ms.append((now_us - decode_live(payload).t_us) / 1000)

    with (
        tempfile.TemporaryDirectory() as name,
        Mosquitto(program, Path(name)) as broker,
        RosGraph(python, Path(name)) as graph,
        subscribed(broker, (*_AGENT, _FLOOR), take),
    ):
        car = broker.car({TOPIC: {"stream": VESC_STREAM, "time": "header"}})
        graph.start("iort_agent.cli", "run", "--config", car)
        every = max(1, round(rate_hz / LIVE_MAX_RATE_HZ))
        floor = (TOPIC, every, broker.port, *broker.identity("floor"), broker.ca, _FLOOR)
        graph.start("bench.floors.mqtt_floor", *floor)
        publisher = graph.publisher(CORE, seconds + _WARM_UP_S, rate_hz=rate_hz)
        publisher.ready()
        publisher.go()
        publisher.publish_for(_WARM_UP_S)
        warm = len(agent_ms), len(floor_ms)
        publisher.finish()
    return Lane(rate_hz, Spread.of(agent_ms[warm[0] :]), Spread.of(floor_ms[warm[1] :]))


def _stamp_us(message: bytes) -> int:
    _, sec, nanosec = struct.unpack_from("<III", message)
    return int(sec * 1_000_000 + nanosec // 1000)
