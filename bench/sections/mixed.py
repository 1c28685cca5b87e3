"""A mixed robot on a real ROS 1 graph: the cost of the agent beside `rosbag record` of the same topics.

Both subscribe to every topic of `bench.ros.mixed_robot` at the same time. So does a bare rospy subscriber,
which shows what Python and rospy take by themselves. The agent publishes to mosquitto, where a watcher counts
everything. Without ROS 1 or mosquitto the section has no figures and says why.
"""

from __future__ import annotations

import json
import shutil
import signal
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from bench.floors.mosquitto import Mosquitto, found, subscribed
from bench.load.counting import await_received, finish
from bench.report import NOT_MEASURED, Section
from bench.ros.mixed_robot import MIXED, topics
from bench.sections import Declared
from iort_agent.status import SOCKET
from iort_contract.messages.batch import decode_batch
from iort_contract.topics import LIVE, RECORD, parse_topic
from testkit import machine
from testkit.ros import PACKAGES, SYSTEM_PYTHON, RosGraph, python_with_rospy
from testkit.target import Say, Target
from testkit.waiting import InstrumentError

SECONDS = 30
RECORDER, AGENT, FLOOR = "rosbag record", "agent", "bare rospy subscriber"
_WARM_UP_S, _CATCH_UP_S, _END_S = 3, 30.0, 30.0
_BASIC_INGEST = "$aws/rules/"
_PACKAGES = f"{PACKAGES} python3-rosbag mosquitto"


@dataclass
class Recorded:
    """The result of a run, by topic or by subscriber. ``late`` samples arrived after the drive."""

    seconds: float = 0.0
    published: Counter[str] = field(default_factory=Counter)
    recorded: Counter[str] = field(default_factory=Counter)
    arrived: Counter[str] = field(default_factory=Counter)
    late: int = 0
    used: dict[str, machine.Usage] = field(default_factory=dict)
    bag_bytes: int = 0
    bag_bz2_bytes: int = 0
    lane_bytes: Counter[str] = field(default_factory=Counter)
    stream_bytes: Counter[str] = field(default_factory=Counter)
    agent: dict[str, Any] = field(default_factory=dict)

    def left_out(self) -> Counter[str]:
        """Return how often the agent reported that it left a field out, by topic."""
        return Counter(
            {
                topic: sum(counts.get("left_out", {}).values())
                for source in self.agent.get("sources", [])
                for topic, counts in source.items()
                if isinstance(counts, dict)
            }
        )

    def lost(self, got: Mapping[str, int]) -> int:
        """Count the messages that are missing in ``got``; a duplicate replaces no missing message."""
        return sum(max(0, sent - got.get(topic, 0)) for topic, sent in self.published.items())


def run(_target: Target | None, say: Say) -> Section:
    """Drive the mixed robot once; the target is not used."""
    section = Section("mixed", "A mixed robot beside rosbag record")
    program = found()
    if program is None or shutil.which("rosmaster") is None or shutil.which("rosbag") is None:
        section.notes.append(f"Not measured here: it needs ROS 1 and mosquitto (apt install {_PACKAGES}).")
    else:
        report(section, measure(program, python_with_rospy(), SECONDS, say))
    return section


def measure(program: str, python: str, seconds: int, say: Say) -> Recorded:
    """Drive for ``seconds``, then wait until the agent has delivered everything."""
    result = Recorded()
    heard: list[tuple[float, str, bytes]] = []
    with (
        tempfile.TemporaryDirectory() as name,
        Mosquitto(program, Path(name)) as broker,
        RosGraph(python, Path(name)) as graph,
        subscribed(
            broker,
            [f"{_BASIC_INGEST}#", f"{RECORD}/#", f"{LIVE}/#"],
            lambda topic, payload: heard.append((time.monotonic(), topic, payload)),
            qos=1,
        ),
    ):
        folder, rosbag = Path(name), [SYSTEM_PYTHON, str(shutil.which("rosbag"))]
        car = broker.car({one.name: {"stream": one.stream, "time": one.time} for one in topics().values()})
        written, bag = folder / "report.json", folder / "drive.bag"
        processes = {
            RECORDER: graph.run([*rosbag, "record", "--quiet", "-O", str(bag), *topics()]),
            AGENT: graph.start(
                "iort_agent.cli", "run", "--config", car, "--report", written, "--drain-s", _CATCH_UP_S
            ),
            FLOOR: graph.start("bench.floors.ros_floor", *topics()),
        }
        publishers = [graph.publisher(node, seconds + _WARM_UP_S, len(processes)) for node in MIXED]
        say("waiting for every subscriber of every topic")
        for publisher in publishers:
            publisher.ready()
        for publisher in publishers:
            publisher.go()
        publishers[0].publish_for(_WARM_UP_S)
        say(f"driving for {seconds} s")
        before, began = machine.usages(processes), time.monotonic()
        publishers[0].publish_for(seconds - 1)
        after, result.seconds = machine.usages(processes), time.monotonic() - began
        for publisher in publishers:
            result.published.update(json.loads(publisher.finish()))
        ended = time.monotonic()
        say("waiting for what is under way")
        streams = {one.stream: result.published[one.name] for one in topics().values()}
        await_received(
            car.parent / SOCKET,
            lambda received: all(received.get(stream, 0) >= count for stream, count in streams.items()),
            within_s=_CATCH_UP_S,
        )
        finish(processes[RECORDER], signal.SIGINT, within_s=_CATCH_UP_S + _END_S)
        finish(processes[AGENT], signal.SIGTERM, within_s=_CATCH_UP_S + _END_S)
        # The agent's last messages are on their way from the broker to the watcher.
        threading.Event().wait(1.0)
        result.agent = json.loads(written.read_text())
        result.bag_bytes, result.recorded = bag.stat().st_size, _in_bag(bag)
        (smaller := folder / "bz2").mkdir()
        compress = [*rosbag, "compress", "--quiet", "--bz2", f"--output-dir={smaller}", str(bag)]
        if graph.run(compress).wait(_END_S + seconds):
            raise InstrumentError("`rosbag compress` failed")
        result.bag_bz2_bytes = (smaller / bag.name).stat().st_size
    for who, usage in after.items():
        result.used[who] = machine.Usage(usage.cpu_s - before[who].cpu_s, usage.rss_mb)
    count(result, heard, ended)
    return result


def _in_bag(bag: Path) -> Counter[str]:
    from rosbags.rosbag1 import Reader  # noqa: PLC0415 - optional, and only this section needs it

    counted: Counter[str] = Counter()
    with Reader(bag) as reader:
        for connection in reader.connections:
            counted[connection.topic] += connection.msgcount
    return counted


def count(result: Recorded, heard: list[tuple[float, str, bytes]], ended: float) -> None:
    """Count the samples and bytes of the messages in ``heard``; a repeated batch counts once."""
    names = {one.stream: one.name for one in topics().values()}
    numbers: set[tuple[str, str, int]] = set()
    for at, whole, payload in heard:
        # By Basic Ingest a topic has the rule before it.
        topic = parse_topic(whole.split("/", 3)[-1] if whole.startswith(_BASIC_INGEST) else whole)
        result.lane_bytes[topic.lane] += len(payload)
        if topic.lane != RECORD:
            continue
        result.stream_bytes[topic.name] += len(payload)
        batch = decode_batch(payload)
        if (topic.name, batch.boot, batch.seq) in numbers:
            continue
        numbers.add((topic.name, batch.boot, batch.seq))
        if topic.name in names:
            result.arrived[names[topic.name]] += len(batch.times_us)
            result.late += len(batch.times_us) if at > ended + 2 else 0


def report(section: Section, result: Recorded) -> None:
    """Add the tables and the ratios."""
    messages = sum(result.published.values())
    # The rates are even, so each stretch has its share of the messages.
    measured = messages * result.seconds / (SECONDS + _WARM_UP_S)
    each_us = {who: usage.cpu_s / measured * 1e6 for who, usage in result.used.items()}
    sent, left_out = result.lane_bytes[RECORD], result.left_out()
    lost = {RECORDER: result.lost(result.recorded), AGENT: result.lost(result.arrived)}
    order = (RECORDER, AGENT, FLOOR)
    rows = [
        ["processor a message", *(f"{each_us[who]:.0f} us" for who in order)],
        ["of one core", *(f"{result.used[who].cpu_s / result.seconds:.1%}" for who in order)],
        ["memory", *(f"{result.used[who].rss_mb:.0f} MB" for who in order)],
        ["messages lost", *(f"{lost[who]:,} of {messages:,}" for who in (RECORDER, AGENT)), NOT_MEASURED],
    ]
    for name, bag_bytes in (
        ("bytes a message, to the file and to the cloud's record lane", result.bag_bytes),
        ("the same, of the bag after rosbag compress --bz2", result.bag_bz2_bytes),
    ):
        rows.append([name, f"{bag_bytes / messages:.0f}", f"{sent / messages:.0f}", NOT_MEASURED])
    title = f"{len(result.published)} topics, {messages:,} messages in {SECONDS + _WARM_UP_S} s"
    section.table(title, ["figure", *order], rows)
    rows = []
    for name, topic in topics().items():
        counts = (
            by_topic[name] for by_topic in (result.published, result.recorded, result.arrived, left_out)
        )
        arrived = result.arrived[name]
        each = f"{result.stream_bytes[topic.stream] / arrived:.0f}" if arrived else NOT_MEASURED
        rows.append([name, topic.kind, *(f"{number:,}" for number in counts), each])
    head = ["topic", "type", "published", "in the bag", "arrived from the agent", "fields left out"]
    section.table("By topic", [*head, "bytes a message"], rows)
    section.ratio("mixed robot: messages that the agent lost", lost[AGENT], 0, unit="messages")
    section.ratio("mixed robot: fields that the agent left out", left_out.total(), 0, unit="fields")
    for who, floor, most in ((RECORDER, "rosbag record's", 0.9), (FLOOR, "a bare rospy subscriber's", None)):
        times = each_us[AGENT] / each_us[who]
        section.ratio(f"mixed robot: the agent's processor / {floor}", times, most, tolerance=2)
    section.ratio("mixed robot: bytes published / bytes of the bag", sent / result.bag_bytes, 1.0)
    section.notes.append(
        f"The agent's live lane published {result.lane_bytes[LIVE] / 1e6:.1f} MB beside; {result.late:,} "
        "samples came over two seconds after the last message. The bag is as `rosbag record`, a program in "
        "C++, writes it: not compressed. What was lost and left out makes the agent's ratios smaller."
    )
    section.raw = {"processor_us": each_us, "lost": lost, "published": dict(result.published)}


SECTION = Declared("a robot of many topics, beside rosbag record", run, cloud=False)
