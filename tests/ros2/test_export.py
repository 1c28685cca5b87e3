"""Recordings on their ways between the agent and ROS 2's own recorder and player."""

from __future__ import annotations

import base64
import json
import signal
import threading
from pathlib import Path
from typing import Any

import pytest
from rosbags import rosbag2
from rosbags.typesys import Stores, get_typestore

from iort_agent.common.threads import SystemClock
from iort_agent.sources.recording import BagConfig
from iort_contract.catalog.streams import TYPES_STREAM
from iort_contract.ros.message import MessageType, RosMessage, message_type
from iort_station.data import bags
from tests.ros.process import Process
from tests.ros.test_source import emitted
from tests.ros2.conftest import Graph

KINDS = {
    "point": "geometry_msgs/msg/PointStamped",
    "label": "std_msgs/msg/String",
    "tf_static": "tf2_msgs/msg/TFMessage",
}
COUNTS = {"point": 60, "label": 60, "tf_static": 1}
NAMES = {"data": "grün ✓"}
FRAME = {"transforms": [{"child_frame_id": "laser", "transform": {"translation": {"x": 0.25}}}]}
TOPICS = {f"/{stream}": {"stream": stream, "time": "arrival"} for stream in KINDS}

Messages = dict[str, list[tuple[int, bytes]]]


@pytest.fixture
def recorder(graph: Graph) -> Graph:
    """A graph of a machine that has the command `ros2 bag`."""
    if not graph.ros2.has("ros2bag"):
        pytest.skip("this ROS 2 has no `ros2 bag`")
    return graph


def publish(graph: Graph) -> list[Process]:
    """Publish everything once all of it has subscribers."""
    return [
        graph.publisher("a", "/point", KINDS["point"], field="point.x", rate=20, count=COUNTS["point"]),
        graph.publisher(
            "b", "/label", KINDS["label"], values=json.dumps(NAMES), rate=20, count=COUNTS["label"]
        ),
        graph.publisher("c", "/tf_static", KINDS["tf_static"], values=json.dumps(FRAME), count=1, latch=True),
    ]


def raws(collector: Process, stream: str) -> list[bytes]:
    return [base64.b64decode(one[3]) for one in emitted(collector, stream)]


def collect(collector: Process, counts: dict[str, int] = COUNTS) -> tuple[dict[str, MessageType], Messages]:
    """The types and messages of a collector that ends when it has so many of each, and the last point."""
    for stream, count in counts.items():
        collector.until(lambda: len(emitted(collector, stream)) >= count, f"{count} messages of {stream}")  # noqa: B023 - called at once
    collector.until(lambda: emitted(collector, "point")[-1][2]["x"] == COUNTS["point"] - 1, "the last point")
    collector.quit()
    kinds = [message_type(one[2]) for one in emitted(collector, TYPES_STREAM)]
    messages = {
        stream: [(one[1] * 1000, base64.b64decode(one[3])) for one in emitted(collector, stream)]
        for stream in COUNTS
    }
    return {kind.stream: kind for kind in kinds}, messages


def played(path: Path) -> tuple[dict[str, MessageType], Messages]:
    """The same of a recording that the agent plays."""
    kinds: dict[str, MessageType] = {}
    messages: Messages = {stream: [] for stream in COUNTS}

    def emit(stream: str, t_us: int, values: Any, *, more: bool = False) -> float:
        if isinstance(values, RosMessage):
            messages[stream].append((t_us * 1000, values.raw))
        else:
            kind = message_type(values)
            kinds[kind.stream] = kind
        return 0.0

    settings: Any = {"topics": tuple((f"/{stream}", stream) for stream in COUNTS), "speed": 0}
    BagConfig(path=path, **settings).build(SystemClock()).run(emit, threading.Event())
    return kinds, messages


def info(graph: Graph, path: Path) -> list[str]:
    told = graph.command("bag", "info", path)
    told.wait()
    return told.lines


def play(graph: Graph, path: Path, *options: object) -> Process:
    # The player ends with its last message, and takes it along unless it waits.
    waits = ("--delay", 3, "--wait-for-all-acked", 10_000)
    return graph.command("bag", "play", path, "--disable-keyboard-controls", *waits, *options)


@pytest.mark.parametrize("ending", [".mcap", ""])
def test_ros2_bag_plays_what_was_exported(recorder: Graph, tmp_path: Path, ending: str) -> None:
    collector, publishers = recorder.collector(TOPICS), publish(recorder)
    kinds, went = collect(collector)
    for publisher in publishers:
        publisher.quit()
    assert {stream: kind.kind for stream, kind in kinds.items()} == KINDS
    path = tmp_path / f"ride{ending}"
    with bags.KINDS[ending](path) as file:
        for stream, kind in kinds.items():
            for t_ns, raw in went[stream]:
                file.topic(kind).write(t_ns, raw)

    told = "\n".join(info(recorder, path))
    for stream, kind in KINDS.items():
        assert f"Topic: /{stream} | Type: {kind} | Count: {COUNTS[stream]} |" in told
    again = recorder.collector(TOPICS)
    # Three seconds take twelve, in which somebody may come late.
    player = play(recorder, path, "--rate", 0.25)
    again.until(lambda: len(raws(again, "label")) >= 10, "ten messages")
    late = recorder.run("listener.py", "late", "/tf_static", KINDS["tf_static"], "--latched")
    heard = late.until(lambda: [line for line in late.lines if line[0] == "["], "the latched message")
    assert json.loads(heard[0])[1]["transforms"][0]["child_frame_id"] == "laser"
    _, came = collect(again)
    player.wait()
    for stream in COUNTS:
        assert [raw for _, raw in came[stream]] == [raw for _, raw in went[stream]]


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_the_agent_plays_what_ros2_bag_recorded(recorder: Graph, tmp_path: Path, storage: str) -> None:
    folder = tmp_path / "ride"
    command = recorder.command("bag", "record", "-s", storage, "-o", folder, *TOPICS)
    collector, publishers = recorder.collector(TOPICS), publish(recorder)
    # Each hears the first messages when it has found their publisher.
    kinds, live = collect(collector, dict.fromkeys(COUNTS, 1))
    for publisher in publishers:
        publisher.quit()
    command.signal(signal.SIGINT)
    command.ended()
    with rosbag2.Reader(folder) as reader:
        recorded: dict[str, list[bytes]] = {stream: [] for stream in COUNTS}
        for connection, _, raw in reader.messages():
            recorded[connection.topic[1:]].append(bytes(raw))
    kinds_again, again = played(folder)
    for stream in COUNTS:
        assert [raw for _, raw in again[stream]] == recorded[stream]
        one, other = kinds[stream], kinds_again[stream]
        assert (one.kind, one.md5sum, one.id) == (other.kind, other.md5sum, other.id)
    points = [raw for _, raw in live["point"]]
    both = min(len(points), len(recorded["point"]))
    assert both > COUNTS["point"] // 2
    assert points[-both:] == recorded["point"][-both:]


def test_ros2_bag_plays_what_ros_1_published(recorder: Graph, tmp_path: Path) -> None:
    name, store = KINDS["point"], get_typestore(Stores.ROS1_NOETIC)
    text, md5sum = store.generate_msgdef(name)
    kind, types = MessageType("point", "/point", name.replace("/msg/", "/"), md5sum, text), store.types
    with bags.folder(tmp_path / "ride") as file:
        write = file.topic(kind).write
        for n in range(30):
            stamp = types["builtin_interfaces/msg/Time"](1_700_000_000 + n, 5)
            header = types["std_msgs/msg/Header"](n, stamp, "map")
            message = types[name](header, types["geometry_msgs/msg/Point"](n / 4, 0.0, -1.0))
            write(1_700_000_000 * 10**9 + n * 50_000_000, bytes(store.serialize_ros1(message, name)))
    listener = recorder.listener("ears", "/point", name)
    play(recorder, tmp_path / "ride").wait()
    heard = listener.until(lambda: [line for line in listener.lines if line[0] == "["][29:], "30 messages")
    message = json.loads(heard[0])[1]
    assert message["header"] == {"stamp": {"sec": 1_700_000_029, "nanosec": 5}, "frame_id": "map"}
    assert message["point"] == {"x": 7.25, "y": 0.0, "z": -1.0}
