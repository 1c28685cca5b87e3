"""Topics that are heard for the ring alone, and messages of which only fields are recorded."""

from __future__ import annotations

import shutil
import sys
import threading
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from iort_agent.config import load_config
from iort_agent.errors import ConfigError
from iort_agent.recorder.config import RecorderConfig
from iort_agent.recorder.ring import Ring
from iort_agent.sources import FAIL, OK, WARN
from iort_agent.sources.intake import Intake
from iort_agent.sources.registry import SourceRun
from iort_agent.sources.ros import RosSource
from iort_agent.sources.ros1 import Ros1Config, TopicConfig
from iort_agent.verbs.check import _recorder
from iort_contract.catalog.streams import TYPES_STREAM
from testkit.agent import ManualClock

HEADER = {"type": "a_msgs/A", "md5sum": "1", "message_definition": "uint8 u\nuint8 v"}
CAR = """\
robot: car1
endpoint: abc-ats.iot.eu-west-1.amazonaws.com
certificate: x
private_key: x
sources:
  - {type: ros1, topics: TOPICS}
"""


class Node:
    """A graph with three topics, that hands over a message of each and then ends the source."""

    failed: str | None = None
    sim_time = False
    topics = ("/camera/image", "/imu", "/speed")

    def __init__(self) -> None:
        self.ready = threading.Event()
        self.heard: dict[str, Intake] = {}

    def resolve(self, topic: str) -> str:
        return topic

    def connections(self, _topic: str) -> int:
        return 1

    def waits(self) -> str | None:
        return None

    def start(self) -> None:
        """Nothing to begin."""

    def close(self) -> None:
        """Nothing to end."""


class Source(RosSource):
    node = Node()

    def join(self) -> Any:
        return self.node

    def listen(self, topic: str, settings: Any, intake: Intake) -> None:
        self.node.heard[topic] = intake
        intake.receive(HEADER, b"\x01\x02")

    def ignore(self, topic: str, intake: Intake) -> None:
        """Nothing to end."""


class Config(Ros1Config):
    def build(self, clock: Any) -> Any:
        return Source(self, clock)


def test_a_topic_for_the_ring_alone_is_heard_and_not_recorded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    topics = (
        ("/imu", TopicConfig(time="arrival", stream="imu", fields=("v",))),
        ("/speed", TopicConfig(time="arrival", stream="speed", only="ring", fields=("v",))),
        ("/none", TopicConfig(time="arrival", stream="none", fields=("absent",))),
        ("/camera/*", TopicConfig(time="arrival", only="ring", large="upload")),
    )
    config = Config(topics)
    assert (config.streams(), config.only_ring()) == (["imu", "none"], ["speed"])
    assert not config.uploads_large(), "nothing of it is uploaded"
    clock, stop = ManualClock(), threading.Event()
    run = SourceRun(config, clock, whole=True)
    ring = Ring(RecorderConfig(keep_free_mb=0.0), clock, folder=tmp_path, run="a", reserve=0)
    recorded: list[tuple[str, Any]] = []

    def emit(stream: str, _t_us: int, values: Any, *, more: bool = False) -> float:
        recorded.append((stream, dict(values)))
        return 0.0

    monkeypatch.setattr(ManualClock, "wait", lambda *_: True)
    run.run(ring.around(emit, run.only_ring), stop)
    ring.work()
    clock.advance(1)
    ring.work()
    kept = {message.channel.topic: message for message in ring.read(0, 2**62)}
    assert set(kept) == {"/imu", "/speed", "/none", "/camera/image"}
    assert {message.data for message in kept.values()} == {b"\x01\x02"}, "whole"
    assert kept["/camera/image"].channel.stream == "camera-image"
    assert [(stream, values) for stream, values in recorded if stream != TYPES_STREAM] == [("imu", {"v": 2})]
    assert [values["stream"] for stream, values in recorded if stream == TYPES_STREAM] == [
        "imu",
        "speed",
        "none",
        "camera-image",
    ]
    assert set(run.report()) == {"/imu", "/speed", "/none", "/camera/image"}
    assert set(run.account()) == {"/imu", "/none"}, "nobody misses the others in the record"
    ring.close()


@pytest.mark.parametrize(
    ("topics", "rest", "said"),
    [
        ("{/a: {time: arrival, only: ring}}", "", "sources[0]: `only: ring` needs the section recorder"),
        ("{/a: {time: arrival, only: disk}}", "recorder:\n", "only: must be one of ring, got 'disk'"),
        (
            "{/a: {time: arrival, only: ring, stream: s}, /b: {time: arrival, stream: s}}",
            "recorder:\n",
            "sources[0]: the stream s is recorded, and for the ring alone",
        ),
        ("{/a: {time: arrival, only: ring, stream: rtt}}", "recorder:\n", "the stream rtt is taken"),
        ("{/a: {time: arrival}}", "recorder: {max_mb: 1}\n", "recorder.max_mb: must be a number from 16 to"),
        ("{/a: {time: arrival}}", "recorder: {topics: []}\n", "recorder.topics: must be a list of at least"),
    ],
)
def test_a_mistake_in_the_configuration_is_told(tmp_path: Path, topics: str, rest: str, said: str) -> None:
    (tmp_path / "x").touch()
    file = tmp_path / "car.yaml"
    file.write_text(CAR.replace("TOPICS", topics) + rest)
    with pytest.raises(ConfigError) as raised:
        load_config(file)
    assert said in str(raised.value)


def test_the_ring_is_beside_the_queue_unless_it_has_a_folder(tmp_path: Path) -> None:
    (tmp_path / "x").touch()
    file = tmp_path / "car.yaml"
    text = CAR.replace("TOPICS", "{/a: {time: arrival, only: ring}}")
    for section, folder in (("recorder:\n", "car1.queue.ring"), ("recorder: {folder: kept}\n", "kept")):
        file.write_text(text + section)
        config = load_config(file)
        assert config.recorder is not None
        assert config.recorder.folder == tmp_path / folder


@pytest.mark.parametrize(
    ("free_mb", "missing", "level"),
    [(5000, False, OK), (1000, False, WARN), (260, False, FAIL), (5000, True, FAIL)],
)
def test_the_check_tells_whether_the_ring_has_room(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, free_mb: int, *, missing: bool, level: str
) -> None:
    (tmp_path / "x").touch()
    file = tmp_path / "car.yaml"
    file.write_text(CAR.replace("TOPICS", "{/a: {time: arrival}}") + "recorder: {max_mb: 2000}\n")
    disk = SimpleNamespace(total=20_000 * 10**6, free=free_mb * 10**6)
    monkeypatch.setattr(shutil, "disk_usage", lambda _: disk)
    if missing:
        monkeypatch.setitem(sys.modules, "mcap.writer", None)
    (finding,) = _recorder(load_config(file))
    assert finding.level == level
    assert bool(finding.todo) == (level != OK)
