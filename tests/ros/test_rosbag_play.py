"""A bag from `iort export`, replayed by ROS' own player into a graph, has the exported messages."""

from __future__ import annotations

import base64
import json
import shutil
import threading
from pathlib import Path
from typing import Any

import pytest

from iort_agent.common.threads import SystemClock
from iort_agent.sources.recording import BagConfig
from iort_contract.ros.message import MessageType, RosMessage, message_type
from iort_station.data import bags
from tests.recordings import recording
from tests.ros.conftest import Graph
from tests.ros.test_source import emitted

VESC, SERVO = "/sensors/core", "/sensors/servo_position_command"
STREAMS = {VESC: "vesc", SERVO: "servo"}
COUNT = 600


@pytest.fixture
def player() -> list[str]:
    if shutil.which("rosbag") is None:
        pytest.skip("ROS 1's player is not installed: apt install python3-rosbag")
    return ["/usr/bin/python3", str(shutil.which("rosbag")), "play"]


def driven(path: Path) -> tuple[dict[str, MessageType], dict[str, list[tuple[int, bytes]]]]:
    """Return the types and the first messages of a real drive, as the agent reads them."""
    kinds: dict[str, MessageType] = {}
    messages: dict[str, list[tuple[int, bytes]]] = {stream: [] for stream in STREAMS.values()}

    def emit(stream: str, t_us: int, values: Any) -> None:
        if isinstance(values, RosMessage):
            messages[stream].append((t_us, values.raw))
        else:
            kind = message_type(values)
            kinds[kind.stream] = kind

    settings: Any = {"topics": tuple(STREAMS.items()), "speed": 0, "stamps": "original"}
    BagConfig(path=path, **settings).build(SystemClock()).run(emit, threading.Event())
    return kinds, {stream: found[:COUNT] for stream, found in messages.items()}


def test_rosbag_play_replays_every_message(graph: Graph, player: list[str], tmp_path: Path) -> None:
    kinds, went = driven(recording("f1tenth-motor-servo.bag"))
    ride = tmp_path / "ride.bag"
    with bags.bag(ride) as file:
        for stream, messages in went.items():
            write = file.topic(kinds[stream]).write
            for t_us, raw in messages:
                write(t_us * 1000, raw)

    config = tmp_path / "source.json"
    topics = {topic: {"stream": stream, "time": "header"} for topic, stream in STREAMS.items()}
    config.write_text(json.dumps({"topics": topics}))
    collector = graph.run("collector.py", config)

    def came(stream: str) -> list[bytes]:
        return [base64.b64decode(one[3]) for one in emitted(collector, stream)]

    # The player drops what its queue cannot hold; its own holds 100 messages.
    playing = graph.start(
        [*player, "--quiet", "--rate=5", f"--queue={COUNT}", "--wait-for-subscribers", str(ride)]
    )
    for stream in STREAMS.values():
        collector.until(lambda stream=stream: len(came(stream)) >= COUNT, f"{COUNT} messages of {stream}")
    playing.wait()
    collector.quit()
    for stream, messages in went.items():
        assert came(stream) == [raw for _, raw in messages]
