"""The source of ROS 2: topics by names and patterns, their streams and times, and what is remembered."""

from __future__ import annotations

import json
import struct
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import yaml

from iort_agent.common.schema import Place, load
from iort_agent.common.threads import WATCH, SystemClock
from iort_agent.errors import ConfigError, SourceError
from iort_agent.ros.qos import QosConfig
from iort_agent.ros.ros2_node import Node
from iort_agent.sources.registry import SOURCES
from iort_agent.sources.repeats import Repeats
from iort_agent.sources.ros1 import Ros1Config
from iort_agent.sources.ros2 import Ros2Config, Ros2Source
from iort_contract.catalog.streams import TYPES_STREAM
from iort_contract.ros.definition import RULE
from iort_contract.ros.message import RosMessage, message_type
from iort_contract.topics import matches, stream_of
from testkit.agent import ManualClock
from testkit.waiting import GUARD_S, until
from tests.unit.agent.ros2_graph import LATCHED, RELIABLE, FakeGraph, FakeTypes

FLOAT, STAMPED = "a_msgs/msg/Float", "a_msgs/msg/Stamped"
TEXTS = {
    FLOAT: "float64 x\n",
    STAMPED: f"std_msgs/Header header\nfloat64 x\n{RULE}\nMSG: std_msgs/Header\n"
    f"builtin_interfaces/Time stamp\nstring frame_id\n{RULE}\nMSG: builtin_interfaces/Time\n"
    "int32 sec\nuint32 nanosec\n",
}


def floats(x: float) -> bytes:
    return b"\0\1\0\0" + struct.pack("<d", x)


def stamped(t_ns: int, x: float) -> bytes:
    return b"\0\1\0\0" + struct.pack("<iIIxxxxd", *divmod(t_ns, 10**9), 1, x)


def config(text: str, kind: str = "ros2") -> Any:
    return load(SOURCES[kind], yaml.safe_load(text), Place(Path("car.yaml")))


class Running(Ros2Source):
    """The source in a graph without ROS, in a thread of its own."""

    def __init__(self, graph: FakeGraph, text: str, queue: Path | None = None, taken: Any = ()) -> None:
        clock = SystemClock()
        super().__init__(config(text), clock)
        self.remember(queue, taken)
        self.samples: list[tuple[str, int, dict[str, Any]]] = []
        self.types: list[Any] = []
        self.error: BaseException | None = None
        self._graph, self._over = graph, threading.Event()
        self._thread = threading.Thread(target=self._in_thread)
        self._thread.start()

    def join(self) -> Node:
        node = Node("iort_agent", self._graph.join, SystemClock(), FakeTypes(TEXTS))
        node.users = 1
        return node

    def _in_thread(self) -> None:
        try:
            self.run(self._take, self._over)
        except BaseException as error:  # noqa: BLE001 - for the test
            self.error = error

    def _take(self, stream: str, t_us: int, values: Any, *, more: bool = False) -> float:
        if stream == TYPES_STREAM:
            self.types.append(message_type(values))
        else:
            self.samples.append((stream, t_us, values))
        return 0.0

    def until_samples(self, count: int) -> None:
        until(lambda: len(self.samples) >= count or self.error)
        assert self.error is None

    def end(self) -> None:
        self._over.set()
        self._thread.join(GUARD_S)


@pytest.fixture
def graph() -> FakeGraph:
    return FakeGraph()


@pytest.fixture
def start(graph: FakeGraph) -> Iterator[Any]:
    started: list[Running] = []

    def make(text: str, **more: Any) -> Running:
        started.append(Running(graph, text, **more))
        return started[-1]

    yield make
    for one in started:
        one.end()


def test_a_message_is_recorded_as_it_was_published(graph: FakeGraph, start: Any) -> None:
    source = start("topics: {/t: {stream: s, time: header}}")
    publisher = graph.publisher("/t", STAMPED)
    until(lambda: graph.subscriptions)
    t_ns = SystemClock().now_us() * 1000 + 789
    publisher.publish(stamped(t_ns, 1.5))
    source.until_samples(1)
    ((stream, t_us, values),) = source.samples
    assert isinstance(values, RosMessage)
    assert (stream, t_us, values.raw, dict(values)) == ("s", t_ns // 1000, stamped(t_ns, 1.5), {"x": 1.5})
    (said,) = source.types
    assert (said.topic, said.kind, said.definition) == ("/t", STAMPED, TEXTS[STAMPED])
    assert source.report() == {
        "/t": {"messages": 1, "silent": False, "left_out": {}, "qos": "reliable, volatile"}
    }


def test_the_time_may_be_that_of_the_middleware(graph: FakeGraph, start: Any) -> None:
    source = start("topics: {/t: {stream: s, time: source}}")
    publisher = graph.publisher("/t", FLOAT)
    until(lambda: graph.subscriptions)
    now_us = SystemClock().now_us()
    publisher.publish(floats(1), (now_us - 5_000_000) * 1000)
    publisher.publish(floats(2), 5_000)
    source.until_samples(2)
    assert source.samples[0][1] == now_us - 5_000_000
    assert abs(source.samples[1][1] - now_us) < GUARD_S * 1_000_000
    assert source.report()["/t"]["unbelieved_stamps"] == 1


def test_topics_are_found_by_patterns_and_names_go_first(graph: FakeGraph, start: Any) -> None:
    text = "topics: {'/a/*': {time: arrival}, /a/named: {stream: mine, time: arrival}, '/*': {time: arrival}}"
    source = start(text, taken=["c"])
    names = ["/a/b/c", "/a/named", "/a/_hidden", "/c", "/account"]
    publishers = [graph.publisher(name, FLOAT) for name in names]
    until(lambda: len(graph.subscriptions) == 4)
    for publisher in publishers:
        publisher.publish(floats(1))
    source.until_samples(4)
    streams = {stream for stream, _, _ in source.samples}
    assert streams == {"a-b-c", "mine", "topic-c", "topic-account"}
    assert set(source.report()) == {"/a/b/c", "/a/named", "/c", "/account"}


def test_a_remapped_topic_is_not_found_again_by_a_pattern(graph: FakeGraph, start: Any) -> None:
    graph.remapped["/t"] = "/robot/t"
    source = start("topics: {/t: {stream: s, time: arrival}, '/robot/*': {time: arrival}}")
    publisher = graph.publisher("/robot/t", FLOAT)
    until(lambda: graph.subscriptions)
    publisher.publish(floats(1))
    source.until_samples(1)
    assert [one[0] for one in source.samples] == ["s"]
    assert source.types[0].topic == "/robot/t"


def test_latched_messages_are_stored_once_over_runs(graph: FakeGraph, start: Any, tmp_path: Path) -> None:
    queue, text = tmp_path / "queue.db", "topics: {/map: {stream: map, time: arrival}}"
    publisher = graph.publisher("/map", FLOAT, LATCHED)
    publisher.publish(floats(1))
    first = start(text, queue=queue)
    first.until_samples(1)
    first.end()
    second = start(text, queue=queue)
    until(lambda: second.report().get("/map", {}).get("latched_again") == 1)
    # The same content published anew is a new message.
    publisher.publish(floats(1))
    second.until_samples(1)
    second.end()
    # Under the name of another stream nothing is stored yet.
    other = start(text.replace("stream: map", "stream: other"), queue=queue)
    other.until_samples(1)


def test_a_type_that_is_not_installed_is_what_the_source_waits_for(graph: FakeGraph, start: Any) -> None:
    source = start("topics: {/t: {stream: s, time: arrival}}")
    graph.publisher("/t", "b_msgs/msg/Lost")
    until(lambda: source.report().get("waits"))
    assert source.report() == {
        "/t": {"messages": 0, "silent": False, "left_out": {}, "type_not_installed": 1},
        "waits": "topic /t: the ROS type b_msgs/msg/Lost is not installed",
    }


def test_malformed_bytes_harm_nothing_else(graph: FakeGraph, start: Any) -> None:
    source = start("topics: {/t: {stream: s, time: header, fields: [x]}}")
    publisher = graph.publisher("/t", STAMPED)
    until(lambda: graph.subscriptions)
    now_ns = SystemClock().now_us() * 1000
    bad = [b"", b"\0\1\0\0", b"\0\x63\0\0" + stamped(now_ns, 1)[4:], stamped(now_ns, 1)[:-3]]
    for data in [*bad, stamped(now_ns, 2)]:
        publisher.publish(data)
    source.until_samples(1)
    assert [values for _, _, values in source.samples] == [{"x": 2.0}]
    assert source.report()["/t"]["malformed"] == len(bad)


def test_a_definition_that_differs_is_not_looked_into(graph: FakeGraph, start: Any) -> None:
    source = start("topics: {/t: {stream: s, time: arrival}}")
    source_types = FakeTypes(TEXTS, {FLOAT: "RIHS01_1"})
    until(lambda: source._node)
    source._node._types.hashes = source_types.hashes
    publisher = graph.publisher("/t", FLOAT, RELIABLE, type_hash="RIHS01_2")
    until(lambda: graph.subscriptions)
    publisher.publish(floats(1))
    source.until_samples(1)
    ((_, _, values),) = source.samples
    assert (values.raw, dict(values)) == (floats(1), {})
    assert source.types[0].md5sum == "RIHS01_2"
    assert source.report()["/t"]["definition_differs"] == 1


def test_a_node_that_ends_ends_the_source(graph: FakeGraph, start: Any) -> None:
    WATCH.on_end(lambda: None)
    graph.fails = RuntimeError("the context is gone")
    source = start("topics: {/t: {stream: s, time: arrival}}")
    until(lambda: source.error)
    assert str(source.error) == "the ROS node /iort_agent has ended: RuntimeError: the context is gone"


@pytest.mark.parametrize("kind", ["ros1", "ros2"])
def test_a_stream_is_that_of_the_settings_or_the_topics_name(kind: str) -> None:
    found = config(
        "topics: {/a/b: {time: arrival}, /c: {stream: x, time: header}, '/d/*': {time: header}}", kind
    )
    assert found.streams() == ["a-b", "x"]
    assert found.describe() == f"ROS {kind[-1]} topics /a/b, /c, /d/*"
    assert found.ros == int(kind[-1])


def test_quality_of_service_may_be_set() -> None:
    text = "topics: {/t: {stream: s, time: source, qos: {reliability: best_effort, depth: 5}}}"
    ((_, topic),) = config(text).topics
    assert topic.qos == QosConfig(reliability="best_effort", depth=5)


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("topics: {t: {time: header}}", "ROS topic must be a full name such as /sensors/core, got 't'"),
        ("topics: {'a/*': {time: header}}", "must be a full name"),
        ("topics: {/motor/1/x: {time: header}}", "must have no part that begins with a digit"),
        ("topics: {/t: {stream: s}}", "time: required"),
        ("topics: {/t: {time: never}}", "one of header, arrival, source"),
        ("topics: {/t: {time: header, qos: {depth: 0}}}", "depth: must be a whole number from 1"),
        ("topics: {/t: {time: header, qos: {reliability: good}}}", "one of reliable, best_effort"),
        ("topics: {/t: {time: header}}\nnode: my-node", "ROS node must be a letter"),
    ],
)
def test_a_mistake_names_what_is_allowed(text: str, problem: str) -> None:
    with pytest.raises(ConfigError) as raised:
        config(text)
    assert problem in str(raised.value)


def test_ros1_has_no_time_of_the_middleware() -> None:
    with pytest.raises(ConfigError, match="one of header, arrival"):
        config("topics: {/t: {stream: s, time: source}}", "ros1")


def test_no_two_topics_have_one_stream() -> None:
    assert stream_of("/a/b_c") == "a-b_c" != stream_of("/a_b/c")
    long = [stream_of("/" + "/".join(["abcdefgh"] * 9) + end) for end in ("/a", "/b")]
    assert long[0] != long[1]
    assert all(len(one) == 64 for one in long)


@pytest.mark.parametrize(
    ("pattern", "topic", "fits"),
    [
        ("/sensors/*", "/sensors/imu", True),
        ("/sensors/*", "/sensors/imu/raw", True),
        ("/sensors/*", "/sensors", False),
        ("/*/scan", "/front/scan", True),
        ("/*/scan", "/front/scan2", False),
        ("/*", "/anything", True),
        ("/*", "/robot/_hidden", False),
        ("/a.b*", "/aXbc", False),
    ],
)
def test_a_star_is_any_characters(pattern: str, topic: str, fits: bool) -> None:
    assert matches(pattern, topic) is fits


def test_without_rclpy_the_source_says_how_to_get_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "rclpy", None)
    source = config("topics: {/t: {stream: s, time: header}}").build(ManualClock())
    with pytest.raises(SourceError, match=r"cannot import rclpy.*setup\.bash.*--system-site-packages"):
        source.run(lambda *_: None, threading.Event())
    (finding,) = Ros2Config(topics=()).check("source")
    assert (finding.level, "finds no rclpy" in finding.text) == ("fail", True)


def test_the_check_tells_which_graph_it_is(monkeypatch: pytest.MonkeyPatch) -> None:
    rclpy = SimpleNamespace(get_rmw_implementation_identifier=lambda: "rmw_any_cpp")
    monkeypatch.setitem(sys.modules, "rclpy", rclpy)
    for name, value in {"ROS_DISTRO": "jazzy", "ROS_DOMAIN_ID": "7", "ROS_LOCALHOST_ONLY": "1"}.items():
        monkeypatch.setenv(name, value)
    monkeypatch.delenv("ROS_AUTOMATIC_DISCOVERY_RANGE", raising=False)
    (finding,) = Ros2Config(topics=()).check("source")
    assert finding.level == "ok"
    python = f"Python {sys.version_info.major}.{sys.version_info.minor}"
    assert finding.text == f"ROS 2 jazzy, {python}, rmw_any_cpp, domain 7, ROS_LOCALHOST_ONLY=1"

    def missing() -> str:
        raise RuntimeError("the middleware is not installed")

    rclpy.get_rmw_implementation_identifier = missing
    (finding,) = Ros2Config(topics=()).check("source")
    assert (finding.level, finding.text) == ("fail", "rclpy: the middleware is not installed")


def test_ros1_patterns_need_the_master(monkeypatch: pytest.MonkeyPatch) -> None:
    found = config("topics: {'/a/*': {time: header, large: upload}}", "ros1")
    assert isinstance(found, Ros1Config)
    assert found.uploads_large()


# What is remembered of latched messages.


def test_the_memory_is_written_once_its_messages_are_in_the_queue(tmp_path: Path) -> None:
    clock, queue = ManualClock(), tmp_path / "queue.db"
    repeats = Repeats(queue, clock)
    assert not repeats.of("s", "/t").came_before("1", b"one")
    repeats.tick()
    clock.advance(1.9)
    repeats.tick()
    assert not (tmp_path / "queue.db.latched").exists()
    clock.advance(0.2)
    repeats.tick()
    assert list(json.loads((tmp_path / "queue.db.latched").read_text())) == ["boot", "s /t"]
    again = Repeats(queue, clock)
    assert again.of("s", "/t").came_before("1", b"one")
    assert not again.of("s", "/t").came_before("1", b"two")
    assert not again.of("other", "/t").came_before("1", b"one")


def test_a_publisher_of_ros_1_is_another_one_after_a_boot(tmp_path: Path) -> None:
    boots = [tmp_path / "first", tmp_path / "second", tmp_path / "missing"]
    for boot in boots[:2]:
        boot.write_text(f"{boot.name}\n")

    def repeats(boot: Path) -> Repeats:
        return Repeats(tmp_path / "queue.db", ManualClock(), boot)

    first = repeats(boots[0])
    for key in ("/map_server", "1700000000000000000"):
        first.of("s", "/t").came_before(key, b"map")
    first.write()
    for boot, known in ((boots[0], True), (boots[1], False), (boots[2], False)):
        again = repeats(boot).of("s", "/t")
        assert again.came_before("/map_server", b"map") is known
        assert again.came_before("1700000000000000000", b"map")


def test_a_message_that_comes_while_another_settles_waits_for_its_own_time(tmp_path: Path) -> None:
    clock, queue = ManualClock(), tmp_path / "queue.db"
    repeats = Repeats(queue, clock)
    repeats.of("s", "/t").came_before("1", b"one")
    repeats.tick()
    clock.advance(2.0)
    repeats.of("s", "/t").came_before("2", b"two")
    repeats.tick()
    # After a crash now, the second message must be stored again.
    crashed = Repeats(queue, clock).of("s", "/t")
    assert crashed.came_before("1", b"one")
    assert not crashed.came_before("2", b"two")
    repeats.tick()
    clock.advance(2.0)
    repeats.tick()
    assert Repeats(queue, clock).of("s", "/t").came_before("2", b"two")


def test_the_memory_is_bounded_and_keeps_topics_that_this_run_has_not_seen(tmp_path: Path) -> None:
    queue = tmp_path / "queue.db"
    first = Repeats(queue, ManualClock())
    for i in range(300):
        first.of("s", "/t").came_before(str(i), b"x")
    first.write()
    second = Repeats(queue, ManualClock())
    second.of("s", "/other").came_before("1", b"x")
    second.write()
    third = Repeats(queue, ManualClock())
    assert [third.of("s", "/t").came_before(str(i), b"x") for i in (299, 44, 43)] == [True, True, False]


@pytest.mark.parametrize("content", [b"", b"[]", b'{"s /t": 5}', b"{" * 100_000, b"\xff"])
def test_a_damaged_memory_is_an_empty_one(
    tmp_path: Path, content: bytes, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / "queue.db.latched").write_bytes(content)
    repeats = Repeats(tmp_path / "queue.db", ManualClock())
    assert not repeats.of("s", "/t").came_before("1", b"x")
    assert "latched messages may be stored again" in caplog.text
    repeats.write()
    assert Repeats(tmp_path / "queue.db", ManualClock()).of("s", "/t").came_before("1", b"x")


def test_a_disk_that_does_not_work_costs_only_the_memory(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    repeats = Repeats(tmp_path / "missing" / "queue.db", ManualClock())
    repeats.of("s", "/t").came_before("1", b"x")
    repeats.write()
    assert "latched messages may be stored again after a restart" in caplog.text
