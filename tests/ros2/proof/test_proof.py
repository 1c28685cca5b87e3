"""A ROS 2 robot of every shape of message, recorded by `ros2 bag record` and by the agent side by side: what
the cloud returns is what the publishers' own records say, byte for byte.

Meanwhile, the network fails, publishers are started again, and the agent is killed. IORT_ROS2_S sets the
duration and IORT_ROS2_REPORT the file of the account, see `make prove-ros2`; RMW_IMPLEMENTATION sets the
middleware.
"""

from __future__ import annotations

import base64
import json
import os
import re
import signal
import threading
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from iort_agent.status import SOCKET
from iort_station.fleet import robots
from local.cloud import EmbeddedCloud
from testkit.proxy import PASS, REFUSE, Proxy
from testkit.ros2 import Ros2
from testkit.waiting import until
from tests.local.conftest import embedded, invoke  # noqa: F401 - a fixture
from tests.ros.process import settled
from tests.ros2.conftest import Graph
from tests.ros2.proof import package
from tests.ros2.proof.account import Account, Contents, Kill, Publisher, Row, Sent, bag, exported, table
from tests.ros2.proof.robot import COMMANDS, NODES, Command, Topic, everything

pytestmark = pytest.mark.heavy

DURATION_S = float(os.environ.get("IORT_ROS2_S") or 20)
OUTAGE_S = max(5.0, DURATION_S / 5)
_AGAIN = "rear"


@dataclass(frozen=True, repr=False)
class Drive:
    """The account of every topic; ``absent`` are topics whose package is not installed."""

    rows: list[Row]
    absent: list[str]
    # Topics whose definition or type is another one in the export than in the bag.
    others: list[str]
    failed: dict[str, str]
    audit_status: int
    audit: dict[str, Any]
    recorder: list[str]


class Robot:
    """The graph with its publishers and its recorder, and the agents beside it."""

    def __init__(self, graph: Graph, cloud: EmbeddedCloud, proxy: Proxy) -> None:
        self.graph, self.cloud, self.proxy, self.out = graph, cloud, proxy, graph.folder
        every = list(everything())
        self.topics = {one.name: one for one in every if graph.ros2.has(one.kind.split("/", 1)[0])}
        self.absent = [one.name for one in every if one.name not in self.topics]
        topics = {
            name: {
                "stream": topic.stream,
                "time": "header" if self._stamped(topic) else "arrival",
                **topic.settings,
            }
            for name, topic in self.topics.items()
        }
        settings = {
            "port": proxy.port,
            "queue": {"path": "spool.db"},
            "files": {"large_folder": "large", "large_every_s": 0, "rate_kb_s": 0},
            "sources": [{"type": "ros2", "topics": topics}],
        }
        self.bundle = robots.add(cloud.cloud, self.out.name, out=self.out, settings=settings)
        self._sent: dict[str, list[Path]] = {}

    def _stamped(self, topic: Topic | Command) -> bool:
        name, _, kind = topic.kind.split("/")
        files = (folder / name / "msg" / f"{kind}.msg" for folder in self.graph.ros2.share)
        text = next(file for file in files if file.exists()).read_text()
        return re.search(r"^(std_msgs/)?Header\s+header\b", text, re.MULTILINE) is not None

    def agent(self) -> Any:
        config = self.bundle.folder / self.bundle.config.name
        return self.graph.module("iort_agent.cli", "run", "--config", config, "--drain-s", 60)

    def publisher(self, node: str, seconds: float, seed: int) -> Any:
        files = self._sent.setdefault(node, [])
        files.append(self.out / f"{node}{len(files)}.sent")
        found = self.graph.run(
            "proof_publisher.py", node, "--seconds", seconds, "--seed", seed, "--sent", files[-1],
            "--without", *self.absent,
        )  # fmt: skip
        found.until(lambda: "ready" in found.lines, "subscribers")
        return found

    def command(self, command: Command) -> Any:
        found = self.graph.command(
            "topic", "pub", "--rate", command.rate_hz, "--wait-matching-subscriptions", 2, *command.options,
            command.name, command.kind, command.values,
        )  # fmt: skip
        found.until(lambda: any("publishing #1:" in line for line in found.lines), "message")
        return found

    def sent(self, node: str, began: int) -> dict[str, list[Sent]]:
        """Read the record of a node's ``began``-th process."""
        found: dict[str, list[Sent]] = {}
        for line in self._sent[node][began].read_text().splitlines():
            topic, t_ns, content = line.split(" ")
            found.setdefault(topic, []).append(Sent(int(t_ns), base64.b64decode(content)))
        return found

    def settled(self) -> bool:
        """Whether the agent has uploaded all that it received, and receives nothing more."""
        return settled(self.bundle.folder / SOCKET, [topic.stream for topic in self.topics.values()])


@pytest.fixture(scope="module")
def drive(
    ros2: Ros2,
    request: pytest.FixtureRequest,
    tmp_path_factory: pytest.TempPathFactory,
) -> Drive:
    if not ros2.has("ros2bag"):
        pytest.skip(f"{ros2.distribution} has no `ros2 bag record`: install rosbag2")
    # After the question for ROS 2: it takes a minute.
    cloud: EmbeddedCloud = request.getfixturevalue("embedded")
    graph = Graph(package.built(ros2) or ros2, tmp_path_factory.mktemp("ros2"))
    try:
        with Proxy("127.0.0.1", cloud.cloud.mqtt_port) as proxy:
            found = _driven(Robot(graph, cloud, proxy))
    finally:
        graph.stop()
    _report(found, graph.ros2, request)
    return found


def _driven(robot: Robot) -> Drive:
    graph, pause = robot.graph, threading.Event()
    recorder = graph.command("bag", "record", "-s", "mcap", "-o", graph.folder / "bag", *robot.topics)
    agent = robot.agent()
    # The commands begin by themselves, as soon as both subscribe.
    agent.until_said("connected to 127.0.0.1")
    commands = {one.name: robot.command(one) for one in COMMANDS.values()}
    publishers = {
        node: robot.publisher(node, DURATION_S * (0.55 if node == _AGAIN else 1), 100 * i)
        for i, node in enumerate(NODES)
    }
    for publisher in publishers.values():
        publisher.say("begin")
    began = time.monotonic()

    def at(part: float) -> None:
        pause.wait(max(0.0, began + part * DURATION_S - time.monotonic()))

    at(0.1)
    robot.proxy.mode = REFUSE
    pause.wait(OUTAGE_S)
    robot.proxy.mode = PASS
    at(0.55)
    first = publishers[_AGAIN]
    first.until(lambda: first.lines[-1].startswith("sent "), "end")
    # What it published is with its subscribers before it leaves.
    pause.wait(1)
    first.quit()
    publishers[_AGAIN] = robot.publisher(_AGAIN, DURATION_S * 0.35, 1000)
    publishers[_AGAIN].say("begin")
    at(0.8)
    killed_ns = time.time_ns()
    agent.kill()
    pause.wait(1)
    agent = robot.agent()
    for publisher in publishers.values():
        publisher.until(lambda publisher=publisher: publisher.lines[-1].startswith("sent "), "end")
    for command in commands.values():
        _interrupt(command)
    until(robot.settled, within_s=300)
    for publisher in publishers.values():
        publisher.say("quit")
    assert agent.terminate() in {0, 1}, "\n".join(agent.errors[-25:])
    _interrupt(recorder)
    stored, failed = _export(robot)
    audited = invoke(robot.cloud.folder, "audit", robot.bundle.robot, "--json")
    assert audited.exit_code in {0, 1}, audited.output
    audit = json.loads(audited.stdout)
    recorded = bag(graph.folder / "bag")
    published, kill = _published(robot, publishers, first, commands, killed_ns)
    account = Account(stored, recorded, kill)
    rows = [
        account.row(name, topic.kind, published[name], named(audit, topic.stream, name), topic.latched)
        for name, topic in robot.topics.items()
    ]
    others = [name for name in stored.kinds if stored.kinds[name][0] != recorded.kinds[name][0]]
    return Drive(rows, robot.absent, others, failed, audited.exit_code, audit, recorder.errors)


def _interrupt(process: Any) -> None:
    """End one of ROS' commands as Ctrl-C does; their statuses differ."""
    process.signal(signal.SIGINT)
    process.ended()


def _published(
    robot: Robot, publishers: dict[str, Any], first: Any, commands: dict[str, Any], killed_ns: int
) -> tuple[dict[str, list[Publisher]], Kill]:
    """Return what each publisher of each topic says that it sent, and when all had found the last agent."""
    found: dict[str, list[Publisher]] = {}
    backs_ns = list[int]()
    for topic, sent in robot.sent(_AGAIN, 0).items():
        found.setdefault(topic, []).append(Publisher(sent, 0))
    for node, publisher in publishers.items():
        changes = [json.loads(line) for line in list(publisher.lines) if line.startswith("{")]
        for topic, sent in robot.sent(node, -1).items():
            back, before = None, 0
            for change in (one for one in changes if one["topic"] == topic):
                if change["t_ns"] > killed_ns and change["subscribers"] > before and back is None:
                    back = change["n"]
                    backs_ns.append(change["t_ns"])
                before = change["subscribers"]
            found.setdefault(topic, []).append(Publisher(sent, back))
    # On a busy machine the next agent may come when all are done.
    back_ns = max(backs_ns, default=time.time_ns())
    done = robot.graph.run(
        "serialized.py", *(part for one in COMMANDS.values() for part in (one.kind, one.values))
    )
    done.wait()
    for command, content in zip(COMMANDS.values(), done.lines, strict=True):
        lines = [line for line in commands[command.name].lines if line.startswith("publishing #")]
        # It tells no time, but its messages are equal: the last ones stand for those around the kill.
        count = int(re.findall(r"#(\d+)", lines[-1])[0])
        end_ns = killed_ns if command.latched else back_ns
        messages = [
            Sent(int(end_ns - (count - i) / command.rate_hz * 1e9), base64.b64decode(content))
            for i in range(count)
        ]
        found[command.name] = [Publisher(messages, None)]
    return found, Kill(killed_ns, back_ns)


def _export(robot: Robot) -> tuple[Contents, dict[str, str]]:
    """Export every stream separately, so that a failing export does not hide the others."""
    paths, failed = [], {}
    for name, topic in robot.topics.items():
        path = robot.out / f"{topic.stream}.mcap"
        arguments = (robot.bundle.robot, topic.stream, "--last", "all", "--out", str(path))
        done = invoke(robot.cloud.folder, "export", *arguments)
        if not done.exit_code:
            paths.append(path)
        elif "has no stream" not in str(done.exception):
            # A stream whose messages were all rejected stores nothing, and the audit must report it.
            failed[name] = f"{done.exception!r}"
    return exported(paths), failed


def named(audit: dict[str, Any], stream: str, topic: str) -> int:
    """Return how many of a topic's messages the audit reports as missing or altered, for any cause."""
    of_stream = [one for one in audit["streams"] if one["stream"] == stream]
    short = sum(fall["samples"] or 0 for one in of_stream for fall in one["shortfalls"])
    sources = [counts for run in audit["not_recorded"].values() for counts in run.values()]
    return short + sum(n for counts in sources for path, n in counts.items() if path.startswith(f"{topic}."))


def _report(drive: Drive, ros2: Ros2, request: pytest.FixtureRequest) -> None:
    """Print the account, and keep it as JSON where one is wanted."""
    middleware = ros2.environment.get("RMW_IMPLEMENTATION", "its own middleware")
    with request.config.pluginmanager.getplugin("capturemanager").global_and_fixture_disabled():
        print(f"\nROS 2 {ros2.distribution}, {middleware}, {DURATION_S:g} s\n{table(drive.rows)}")  # noqa: T201 - the proof's result
        for line in [
            *drive.others,
            *(f"{one.topic}: {one.difference}" for one in drive.rows if one.difference),
        ]:
            print(line)  # noqa: T201 - as above
        if drive.absent:
            print("not installed:", *drive.absent)  # noqa: T201 - as above
    if path := os.environ.get("IORT_ROS2_REPORT"):
        content = {
            "distribution": ros2.distribution,
            "middleware": middleware,
            "seconds": DURATION_S,
            "audit_status": drive.audit_status,
            "absent": drive.absent,
            "topics": [one.as_json() for one in drive.rows],
        }
        Path(path).parent.mkdir(parents=True, exist_ok=True)
        Path(path).write_text(json.dumps(content, indent=1) + "\n")


def test_every_message_is_stored_as_published_or_its_loss_is_explained(drive: Drive) -> None:
    assert not drive.failed
    assert [one for one in drive.rows if one.unexplained] == []


def test_what_was_recorded_is_of_the_same_types(drive: Drive) -> None:
    assert drive.others == []
    # The recorder too may miss messages while it waits for a busy machine; it has none that nobody sent.
    assert sum(one.unrecorded for one in drive.rows) <= sum(one.published for one in drive.rows) / 100


def test_every_stream_is_audited(drive: Drive) -> None:
    streams = {one["stream"] for one in drive.audit["streams"]}
    assert {one.topic[1:].replace("/", "_") for one in drive.rows} <= streams


def test_the_robot_has_twenty_types(drive: Drive) -> None:
    assert len({one.kind for one in drive.rows}) >= 20
