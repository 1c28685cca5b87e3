"""What `iort export` writes as a bag, replayed by ROS' own player into a graph, is what was exported."""

from __future__ import annotations

import json
import shutil
import threading
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from contract import TYPES_STREAM, FrameId, MessageType, frame_id, message_type
from device.clock import SystemClock
from device.sources.bag import BagConfig
from station import recordings
from station.blocks import Block
from station.messages import Maker
from tests.recordings import recording
from tests.ros.conftest import Graph

VESC, SERVO = "/sensors/core", "/sensors/servo_position_command"
STREAMS = {VESC: "vesc", SERVO: "servo"}
COUNT = 600

Samples = list[tuple[int, dict[str, Any]]]


@pytest.fixture
def player() -> list[str]:
    if shutil.which("rosbag") is None:
        pytest.skip("ROS 1's player is not installed: apt install python3-rosbag")
    return ["/usr/bin/python3", str(shutil.which("rosbag")), "play"]


def driven(path: Path) -> tuple[dict[str, MessageType], dict[str, Samples]]:
    """The types and the first samples of a real drive, as the agent reads them, as if it had ended now:
    a source does not believe stamps of years ago."""
    kinds: dict[str, MessageType] = {}
    samples: dict[str, Samples] = {stream: [] for stream in STREAMS.values()}
    stop = threading.Event()

    def emit(stream: str, t_us: int, values: Any) -> None:
        if stream != TYPES_STREAM:
            samples[stream].append((t_us, dict(values)))
        elif "kind" in values:
            kind = message_type(values)
            kinds[kind.stream] = kind

    settings: Any = {"topics": tuple(STREAMS.items()), "speed": 0, "stamps": "original"}
    clock = SystemClock()
    BagConfig(path=path, **settings).build(clock).run(emit, stop)
    later_us = clock.now_us() - max(found[-1][0] for found in samples.values())
    return kinds, {
        stream: [(t_us + later_us, values) for t_us, values in found[:COUNT]]
        for stream, found in samples.items()
    }


def block(samples: Samples) -> Block:
    columns = {name: np.array([values[name] for _, values in samples]) for name in samples[0][1]}
    return Block(np.array([t_us for t_us, _ in samples]), columns)


def test_every_message_comes_back_from_rosbag_play(graph: Graph, player: list[str], tmp_path: Path) -> None:
    kinds, went = driven(recording("f1tenth-motor-servo.bag"))
    # The car of the recording names no frame.
    framed = {"base_link": went["vesc"][0][0], "odom": went["vesc"][COUNT // 2][0]}
    ride = tmp_path / "ride.bag"
    with recordings.bag(ride) as file:
        for stream, samples in went.items():
            frames = [FrameId(stream, VESC, name, t_us) for name, t_us in framed.items()]
            maker = Maker(kinds[stream], list(samples[0][1]), frames=frames)
            assert not maker.lacking
            assert file.add(maker, iter([block(samples)])) == COUNT

    config = tmp_path / "source.json"
    topics = {topic: {"stream": stream, "time": "header"} for topic, stream in STREAMS.items()}
    config.write_text(json.dumps({"topics": topics}))
    collector = graph.run("collector.py", config)

    def came(stream: str) -> Samples:
        found = [json.loads(line) for line in list(collector.lines)]
        return [(one[1], one[2]) for one in found if isinstance(one, list) and one[0] == stream]

    playing = graph.start([*player, "--quiet", "--rate", "5", "--wait-for-subscribers", str(ride)])
    for stream in STREAMS.values():
        collector.until(lambda stream=stream: len(came(stream)) >= COUNT, f"{COUNT} samples of {stream}")
    playing.wait()
    collector.quit()
    # Field by field and to the microsecond, which is the resolution of a sample.
    assert came("vesc") == went["vesc"]
    # A Float64 has no stamp of its own: its time is when it came.
    assert [values for _, values in came("servo")] == [values for _, values in went["servo"]]
    # A Float64 has no header either, and the frames are told of the samples that they begin with.
    told = [frame_id(sample) for _, sample in came(TYPES_STREAM) if "frame_id" in sample]
    assert {(f.topic, f.frame_id): f.since_us for f in told} == {
        (VESC, name): t_us for name, t_us in framed.items()
    }
