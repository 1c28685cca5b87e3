"""Each long-lived thread of the agent fails once: it is told, and goes on or ends the process."""

from __future__ import annotations

import ast
import datetime as dt
import logging
import socket
import sys
import threading
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Callable
from unittest.mock import Mock

import pytest

import iort_agent
from iort_agent.agent import Agent, make_status
from iort_agent.common.schema import Place, load
from iort_agent.common.threads import (
    END,
    FIRST_S,
    RESTART,
    THREADS,
    WATCH,
    Kind,
    Supervised,
    SystemClock,
    Watch,
)
from iort_agent.config import Config
from iort_agent.control.config import DownlinkConfig
from iort_agent.errors import AgentError
from iort_agent.files.folder import FilesConfig
from iort_agent.lanes import PingConfig
from iort_agent.mqtt.aws import IotCore
from iort_agent.mqtt.client import Broker, Network
from iort_agent.mqtt.dispatch import Dispatcher
from iort_agent.recorder.config import RecorderConfig
from iort_agent.ros import ros2_node as ros2_module
from iort_agent.ros.ros1_node import Node
from iort_agent.runtime import Runtime
from iort_agent.sources.sim import SimConfig
from iort_agent.spool.sqlite import SqliteSpool
from iort_agent.status import StatusServer, fetch
from iort_agent.video import Frame, Pictures
from iort_agent.video.camera import Camera
from iort_agent.video.capture import Capture
from iort_agent.video.config import SimCamera, VideoConfig
from iort_contract.messages.batch import decode_batch
from testkit.agent import Loopback, ManualClock, Published
from tests.unit.agent.control import test_guard
from tests.unit.agent.control.downlink_rig import FakeGraph
from tests.unit.agent.control.test_peers import ANSWERS, NAME, TOPIC, AskingRig, string
from tests.unit.agent.ros2_graph import FakeGraph as Ros2Graph
from tests.unit.agent.test_agent import DOWNLINK
from tests.unit.agent.test_identity import made, text

SOON_S = 30.0
WHY = "Surprise: of a kind that nobody handles"


class Surprise(BaseException):
    """What no handler of exceptions expects."""


def surprise() -> Any:
    raise Surprise("of a kind that nobody handles")


class Trap:
    """The machine's clock. It raises once in the thread of a kind, and notices when that thread is back."""

    def __init__(self, kind: str) -> None:
        self._kind, self._raised, self.back = kind, False, threading.Event()

    def now_us(self) -> int:
        self._pass()
        return time.time_ns() // 1000

    def monotonic(self) -> float:
        self._pass()
        return time.monotonic()

    def wait(self, event: threading.Event, seconds: float | None) -> bool:
        self._pass()
        return event.wait(seconds)

    def _pass(self) -> None:
        name = threading.current_thread().name
        if name != self._kind and not name.startswith(f"{self._kind} "):
            return
        if self._raised:
            self.back.set()
        else:
            self._raised = True
            surprise()


def alarms(kind: str) -> list[str]:
    return [alarm for alarm in WATCH.alarms() if alarm.startswith(f"the thread {kind}")]


def in_the_whole_agent(kind: str, folder: Path, _patch: pytest.MonkeyPatch) -> None:
    """The agent goes on, says what failed, and loses no sample."""
    clock = Trap(kind)
    files = folder / "files"
    files.mkdir()
    config = Config(
        "car1",
        "host",
        Path(),
        Path(),
        (SimConfig(),),
        downlink=load(DownlinkConfig, DOWNLINK, Place(folder / "car.yaml")),
        ping=PingConfig(rate_hz=20, paths=("broker",)),
        files=FilesConfig(folder=files),
        recorder=RecorderConfig(folder=folder / "ring", keep_free_mb=0),
        video=VideoConfig(SimCamera()),
    )
    uplink = Loopback(clock, Dispatcher())
    spool = SqliteSpool(folder / "queue.db", max_bytes=10**9, clock=clock)
    spool.start()
    agent = Agent(config, uplink=uplink, spool=spool, clock=clock)
    runtime = Runtime(agent)
    topic, recorded = "$aws/rules/iort_record/dt/iort/car1/vesc", threading.Event()

    def verdict(message: Published) -> None:
        if message.topic == topic:
            recorded.set()

    uplink.verdict = verdict
    ended: list[int] = []
    run = threading.Thread(target=lambda: ended.append(runtime.run(drain_s=SOON_S)))
    run.start()
    try:
        assert clock.back.wait(SOON_S), f"{kind} does not go on"
        assert recorded.wait(SOON_S), "no sample is recorded any more"
        (alarm,) = [alarm for alarm in make_status(agent).alarms if "the thread" in alarm]
        assert alarm.startswith(f"the thread {kind}")
        assert alarm.endswith(WHY)
    finally:
        runtime.stop()
        run.join()
        spool.close()
    assert ended == [0]
    batches = {
        batch.seq: batch for m in uplink.published if m.topic == topic for batch in [decode_batch(m.payload)]
    }
    stored = sum(len(batch.times_us) for batch in batches.values())
    assert stored == agent.streams.counts()["vesc"].samples > 0


def asks(kind: str, _folder: Path, _patch: pytest.MonkeyPatch) -> None:
    """The question after the one that failed is answered."""

    class Graph(FakeGraph):
        def publish(self, topic: str, data: bytes) -> bool:
            if topic == ANSWERS and not alarms(kind):
                surprise()
            return super().publish(topic, data)

    graph = Graph()
    rig = AskingRig(graph, {NAME: {"timeout_s": SOON_S}})
    try:
        for _ in range(2):
            graph.hear(TOPIC, "std_msgs/String", string("{}"))
        graph.await_published(1)
        assert alarms(kind)[0].endswith(WHY)
    finally:
        rig.close()


def camera(kind: str, _folder: Path, _patch: pytest.MonkeyPatch) -> None:
    """The camera is opened again."""

    class Eye(Camera):
        def open(self) -> None:
            if not alarms(kind):
                surprise()

        def read(self, number: int, stop: threading.Event) -> Frame | None:
            return None if stop.wait(0.001) else Frame(number, 0, float(number), Mock())

        def close(self) -> None:
            pass

    taken = threading.Event()
    capture = Capture(Eye, SystemClock(), take=lambda _: taken.set(), pictures=Pictures())
    capture.start()
    try:
        capture.want(wanted=True)
        assert taken.wait(SOON_S)
        assert alarms(kind)[0].endswith(WHY)
    finally:
        capture.close()


def guard(_kind: str, folder: Path, patch: pytest.MonkeyPatch) -> None:
    """It still notices that the agent is back, and ends."""
    node, looks = test_guard.Node(), iter([surprise, frozenset, *[lambda: frozenset(["back"])] * 3])
    patch.setattr(node, "living", lambda _name: next(looks)())
    patch.setattr(test_guard.guard_module, "_LOOK_S", 0.01)
    test_guard.guarded(node, patch, ["/speed", None, True], queue=folder / "queue.db")
    assert next(looks, None) is None


def ros1_node(kind: str, _folder: Path, patch: pytest.MonkeyPatch) -> None:
    """The process ends."""
    names = SimpleNamespace(
        load_mappings=lambda _: {}, get_ros_namespace=lambda: "/", ns_join=lambda one, other: one + other
    )
    patch.setitem(sys.modules, "rosgraph", SimpleNamespace(get_master_uri=lambda: "http://127.0.0.1:1"))
    patch.setitem(sys.modules, "rosgraph.names", names)
    patch.setattr("iort_agent.ros.ros1_master.Master.unreachable", lambda _: surprise())
    ended = threading.Event()
    WATCH.on_end(ended.set)
    node = Node("iort_agent", Mock(), Trap("nobody"))
    node.users = 1
    node.start()
    assert ended.wait(SOON_S)
    assert "so the agent ends" in alarms(kind)[0]
    assert node.failed == f"the ROS node /iort_agent has ended: {WHY}"
    node._thread.join(SOON_S)


def ros2_node(kind: str, _folder: Path, _patch: pytest.MonkeyPatch) -> None:
    """The process ends."""
    ended = threading.Event()
    WATCH.on_end(ended.set)
    graph = Ros2Graph()
    graph.fails = Surprise("of a kind that nobody handles")
    node = ros2_module.Node("iort_agent", graph.join, SystemClock())
    node.users = 1
    node.start()
    assert ended.wait(SOON_S)
    assert "so the agent ends" in alarms(kind)[0]
    assert node.failed == f"the ROS node /iort_agent has ended: {WHY}"
    node._thread.join(SOON_S)


def status(kind: str, folder: Path, patch: pytest.MonkeyPatch) -> None:
    """It answers the next question."""
    patch.setattr("iort_agent.status._TIMEOUT_S", SOON_S)
    server = StatusServer(folder / "agent.sock", lambda: {"alarms": alarms(kind) or surprise()})
    server.start()
    try:
        with pytest.raises(AgentError, match="gave no status"):
            fetch(folder / "agent.sock")
        assert fetch(folder / "agent.sock")["alarms"][0].endswith(WHY)
    finally:
        server.stop()


def uplink(kind: str, folder: Path, _patch: pytest.MonkeyPatch) -> None:
    """It tries to connect again."""
    now = dt.datetime.now(dt.timezone.utc)
    certificate, key = made(now, now + dt.timedelta(days=1))
    files = {"certificate": folder / "certificate.pem", "private_key": folder / "private.key"}
    files["certificate"].write_text(text(certificate))
    files["private_key"].write_text(key)
    clock = Trap(kind)
    # Nothing listens at port 9 of this machine.
    broker = Broker("127.0.0.1", 9, "car1", **files)
    kernel, notices = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
    connection = IotCore(broker, clock=clock, dispatcher=Dispatcher(), network=lambda: Network(notices))
    with kernel:
        connection.start()
        try:
            assert clock.back.wait(SOON_S)
            assert alarms(kind)[0].endswith(WHY)
        finally:
            connection.stop(SOON_S)


Scenario = Callable[[str, Path, pytest.MonkeyPatch], None]
SCENARIOS: dict[str, Scenario] = {
    **dict.fromkeys(
        [
            *("callbacks", "downlink", "incidents", "pings", "record", "recorder", "ring"),
            *("source", "spool", "ticker", "uploads", "video"),
        ],
        in_the_whole_agent,
    ),
    "asks": asks,
    "camera": camera,
    "guard": guard,
    "ros1 node": ros1_node,
    "ros2 node": ros2_node,
    "status": status,
    "uplink": uplink,
}


@pytest.mark.parametrize("kind", THREADS)
def test_a_thread_that_fails_once_is_told_and_goes_on_or_ends_the_process(
    kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    errors = WATCH.errors
    SCENARIOS[kind](kind, tmp_path, monkeypatch)
    assert WATCH.errors == errors + 1
    (line,) = [r for r in caplog.records if r.levelno >= logging.ERROR and r.message.startswith("the thread")]
    assert line.message.startswith(f"the thread {kind}")


def test_no_thread_of_the_agent_is_outside_of_the_supervised_loop() -> None:
    """`threads` starts every thread; what it starts elsewhere is in its registry."""
    package = Path(iort_agent.__file__).parent
    for file in package.rglob("*.py"):
        names = {
            node.attr if isinstance(node, ast.Attribute) else getattr(node, "id", "")
            for node in ast.walk(ast.parse(file.read_text()))
        }
        started = names & {"Thread", "Timer", "ThreadPoolExecutor", "start_new_thread"}
        assert not started or file.name == "threads.py", file


def test_waits_double_and_begin_anew_after_a_minute_without_an_error() -> None:
    clock, watch = ManualClock(), Watch()
    lasts = iter([0.0] * 9 + [61.0] + [0.0] * 3)
    began: list[float] = []

    def run() -> None:
        began.append(clock.monotonic())
        clock.advance(next(lasts))
        if len(began) < 13:
            raise ValueError("again")

    thread = Supervised("pings", run, clock=clock, watch=watch)
    thread.start()
    while thread.is_alive():
        time.sleep(0.001)
    waits = [round(later - earlier, 3) for earlier, later in zip(began, began[1:])]
    assert waits == [*[FIRST_S * 2**i for i in range(7)], 10, 10, 61 + FIRST_S, 0.2, 0.4]
    assert watch.errors == 12
    assert watch.alarms() == [], "the thread has ended"


def test_a_thread_that_cannot_start_again_ends_the_process_and_does_not_start_again() -> None:
    ended, runs = [], []
    watch = Watch()
    watch.on_end(lambda: ended.append(True))

    def run() -> None:
        runs.append(True)
        surprise()

    thread = Supervised("ros1 node", run, watch=watch)
    assert THREADS["ros1 node"] == Kind(END) != Kind(RESTART)
    thread.start()
    thread.join(0)
    thread.join(SOON_S)
    assert (runs, ended) == ([True], [True])


def test_the_same_error_is_logged_once_a_minute(caplog: pytest.LogCaptureFixture) -> None:
    clock, runs = ManualClock(), iter(range(60))

    def run() -> None:
        if next(runs) < 59:
            raise ValueError("again")

    thread = Supervised("spool", run, clock=clock, watch=Watch())
    thread.start()
    # `join` would end it.
    thread._thread.join(SOON_S)
    assert 1 <= caplog.text.count("the thread spool failed") <= 2
