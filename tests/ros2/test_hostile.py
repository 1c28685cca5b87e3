"""What no publisher should send, on a real graph: it is counted and named, and harms nothing else."""

from __future__ import annotations

import base64
import json
import struct
from pathlib import Path
from typing import Any

import pytest

from testkit.waiting import until
from tests.ros.agents import agent_of
from tests.ros.process import Process
from tests.ros2.conftest import Graph
from tests.ros2.proof.account import whole

IMU, FLOAT, IMAGE = "sensor_msgs/msg/Imu", "std_msgs/msg/Float64", "sensor_msgs/msg/CompressedImage"
# An encapsulation header of CDR, little-endian, and a stamp with the empty name of a frame.
_CDR = b"\x00\x01\x00\x00"
_HEADER = struct.pack("<iII", 1_700_000_000, 0, 1) + b"\0" * 4
GOOD = _CDR + _HEADER + struct.pack("<37d", *range(37))
MALFORMED = {
    "a header alone": _CDR,
    "cut short": GOOD[:100],
    "cut in a number": GOOD[:-6],
    "a text beyond the end": _CDR + struct.pack("<iII", 1, 0, 2**31) + GOOD[20:],
    "a text of 4 GB": _CDR + struct.pack("<iII", 1, 0, 2**32 - 1) + GOOD[20:],
    "of another type": _CDR + struct.pack("<6d", *range(6)),
}
# Cyclone DDS drops their packets, and sends them again for ever: nobody hears the topic any more.
OF_NO_ENCODING = {
    "an unknown encoding": b"\x00\x63\x00\x00" + GOOD[4:],
    "random": bytes((i * 7919 + i * i) & 0xFF for i in range(500)),
}


def malformed(graph: Graph) -> list[bytes]:
    cyclone = graph.environment.get("RMW_IMPLEMENTATION") == "rmw_cyclonedds_cpp"
    return [*MALFORMED.values(), *(() if cyclone else OF_NO_ENCODING.values())]


class Raw:
    """A publisher that does as it is told."""

    def __init__(self, graph: Graph, **kinds: str) -> None:
        self.process = graph.run(
            "raw_publisher.py", "raw", *(f"/{name}={kind}" for name, kind in kinds.items())
        )
        self._done = 0

    def ready(self) -> None:
        self.process.until(lambda: "ready" in self.process.lines, "subscribers")

    def tell(self, command: str) -> None:
        self._done += 1
        self.process.say(command)
        self.process.until(lambda: self.process.lines.count("done") >= self._done, "end of the command")

    def send(self, topic: str, content: bytes) -> None:
        self.tell(f"send {topic} {base64.b64encode(content).decode()}")

    def refused(self) -> int:
        """How many messages the middleware refused to send."""
        return sum(line.startswith("refused ") for line in self.process.lines)


def samples(collector: Process, stream: str) -> list[list[Any]]:
    found = [json.loads(line) for line in list(collector.lines) if line.startswith("[")]
    return [one for one in found if one[0] == stream]


def test_malformed_messages_are_counted_and_others_read(graph: Graph) -> None:
    picked = {"stream": "imu", "time": "header", "fields": ["linear_acceleration.x"]}
    collector = graph.collector({"/imu": picked, "/good": {"stream": "good", "time": "arrival"}})
    raw = Raw(graph, imu=IMU, good=FLOAT)
    raw.ready()
    raw.send("/imu", GOOD)
    for content in malformed(graph):
        raw.send("/imu", content)
        raw.send("/good", _CDR + struct.pack("<d", 1.5))
    raw.send("/imu", GOOD)
    collector.until(lambda: len(samples(collector, "imu")) == 2, "both good messages")
    collector.until(
        lambda: len(samples(collector, "good")) == len(malformed(graph)), "the other topic's messages"
    )
    report = json.loads(collector.quit()[-1])
    assert [one[2] for one in samples(collector, "imu")] == [{"linear_acceleration.x": 25.0}] * 2
    assert report["/imu"]["malformed"] + raw.refused() == len(malformed(graph))
    assert report["/imu"]["messages"] + raw.refused() == len(malformed(graph)) + 2


def test_whole_messages_are_kept_as_they_came(graph: Graph) -> None:
    collector = graph.collector({"/imu": {"stream": "imu", "time": "header"}})
    raw = Raw(graph, imu=IMU)
    raw.ready()
    for content in [GOOD, *malformed(graph), GOOD]:
        raw.send("/imu", content)
    count = 2 + len(malformed(graph)) - raw.refused()
    collector.until(lambda: len(samples(collector, "imu")) == count, "every message")
    kept = [base64.b64decode(one[3]) for one in samples(collector, "imu")]
    assert kept[0] == kept[-1] == GOOD
    assert set(kept) <= {whole(content) for content in (GOOD, *malformed(graph))}


def test_messages_of_ten_megabytes_disturb_no_other_topic(graph: Graph) -> None:
    topics = {
        "/camera": {"stream": "camera", "time": "arrival", "large": "upload"},
        "/good": {"stream": "good", "time": "arrival"},
    }
    collector = graph.collector(topics)
    good = graph.publisher("good", "/good", FLOAT, field="data", rate=100, count=300)
    raw = Raw(graph, camera=IMAGE)
    raw.ready()
    for _ in range(3):
        raw.tell("large /camera 10000000")
    collector.until(lambda: len(samples(collector, "camera")) == 3, "the large messages")
    collector.until(lambda: len(samples(collector, "good")) == 300, "the other topic's messages")
    assert [one[2]["data"] for one in samples(collector, "good")] == list(range(300))
    for one in samples(collector, "camera"):
        assert len(base64.b64decode(one[3])) > 10_000_000
    good.quit()


@pytest.mark.parametrize("count", [200])
def test_hundreds_of_topics_are_recorded_by_one_pattern(graph: Graph, tmp_path: Path, count: int) -> None:
    raw = Raw(graph, **{f"many/t{i}": FLOAT for i in range(count)})
    pattern = {"/many/*": {"time": "arrival"}}
    agent = agent_of(graph, tmp_path, {"type": "ros2", "topics": pattern})
    raw.ready()
    raw.tell("each 20")
    until(lambda: sum(agent.samples(f"many-t{i}") for i in range(count)) == 20 * count)
    assert agent.process.terminate() == 0, "\n".join(agent.process.errors)
