"""Measures the delay from ROS publish to an MQTT subscriber over the live lane, through mosquitto.

The floor is a bare rospy subscriber that hands the same messages, at the same rate, to a bare MQTT client.
Both use the same topic, broker, TLS and subscriber at the same time.
"""

from __future__ import annotations

import struct
import tempfile
from dataclasses import dataclass
from pathlib import Path

import yaml

from bench.floors.mosquitto import HOST, Mosquitto
from bench.meters.watcher import listening, live_us
from bench.ros.graph import RosGraph
from iort_contract.catalog.vesc import VESC_STREAM
from iort_contract.limits import LIVE_MAX_RATE_HZ
from iort_contract.topics import LIVE, build_topic, live_topic
from local.figures import Spread

TOPIC = "/sensors/core"
_ROBOT, _FLOOR = "bench", "bench/floor"
# A live message goes one way or the other; unlike AWS IoT, mosquitto delivers both.
_AGENT = (build_topic(LIVE, _ROBOT, VESC_STREAM), live_topic(_ROBOT, VESC_STREAM))
_WARM_UP_S = 3


@dataclass(frozen=True)
class Lane:
    """The delays at one rate, of the agent and of the floor."""

    rate_hz: int
    agent_ms: Spread
    floor_ms: Spread

    @staticmethod
    def shown(spread: Spread) -> str:
        """Format to a hundredth of a ms; the two differ by no more."""
        return "-" if spread.p50 is None else f"{spread.p50:.2f} ms (p95 {spread.p95:.2f})"


def measure(program: str, python: str, rate_hz: int, seconds: int) -> Lane:
    """Run both side by side. Raises `RosError` if one of the processes stops."""
    with (
        tempfile.TemporaryDirectory() as name,
        Mosquitto(program, Path(name)) as broker,
        RosGraph(python, Path(name)) as graph,
    ):
        certificate, key = broker.identity("watcher")
        with listening(
            endpoint=HOST,
            port=broker.port,
            certificate=certificate,
            key=key,
            ca=broker.ca,
            took_us={**dict.fromkeys(_AGENT, live_us), _FLOOR: _stamp_us},
        ) as heard:
            graph.start("iort_agent.cli", "run", "--config", _car(broker, Path(name)))
            every = max(1, round(rate_hz / LIVE_MAX_RATE_HZ))
            floor = (TOPIC, every, broker.port, *broker.identity("floor"), broker.ca, _FLOOR)
            graph.start("bench.floors.mqtt_floor", *floor)
            publisher = graph.publisher(TOPIC, rate_hz, rate_hz * (seconds + _WARM_UP_S))
            publisher.begin()
            publisher.publish_for(_WARM_UP_S)
            before = {topic: len(delays) for topic, delays in heard.items()}
            publisher.finish()
            measured = {topic: delays[before[topic] :] for topic, delays in heard.items()}
            agent = [delay for topic in _AGENT for delay in measured[topic]]
    return Lane(rate_hz, Spread.of(agent), Spread.of(measured[_FLOOR]))


def _car(broker: Mosquitto, folder: Path) -> Path:
    certificate, key = broker.identity(_ROBOT)
    config = folder / "car.yaml"
    config.write_text(
        yaml.safe_dump(
            {
                "robot": _ROBOT,
                "endpoint": HOST,
                "port": broker.port,
                "certificate": str(certificate),
                "private_key": str(key),
                "root_ca": str(broker.ca),
                "sources": [{"type": "ros1", "topics": {TOPIC: {"stream": VESC_STREAM, "time": "header"}}}],
                "queue": {"path": "spool.db"},
            }
        )
    )
    return config


def _stamp_us(message: bytes) -> int:
    _, sec, nanosec = struct.unpack_from("<III", message)
    return int(sec * 1_000_000 + nanosec // 1000)
