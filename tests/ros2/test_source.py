"""The source `ros2` on a real graph: what appears, changes, restarts and disagrees."""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import Any

import pytest

from testkit.waiting import until
from tests.ros.agents import Agent, agent_of
from tests.ros.process import WAIT_S, Process
from tests.ros2.conftest import Graph

TWIST, FLOAT, INT = "geometry_msgs/msg/TwistStamped", "std_msgs/msg/Float64", "std_msgs/msg/Int32"
# The field that counts, and its name in a sample: the only field behind the header is left out of paths.
SPEED, COUNT = "twist.linear.x", "linear.x"
WHEEL = {"/wheel": {"stream": "wheel", "time": "header"}}


def emitted(collector: Process, stream: str) -> list[tuple[int, dict[str, Any]]]:
    found = [json.loads(line) for line in list(collector.lines) if line.startswith("[")]
    return [(one[1], one[2]) for one in found if one[0] == stream]


def counts(collector: Process, stream: str = "wheel", field: str = COUNT) -> list[int]:
    return [int(values[field]) for _, values in emitted(collector, stream) if field in values]


def until_count(collector: Process, least: int, stream: str = "wheel", field: str = COUNT) -> None:
    collector.until(
        lambda: max(counts(collector, stream, field), default=-1) >= least, f"{least} of {stream}"
    )


def twists(graph: Graph, name: str = "pub", topic: str = "/wheel", **options: Any) -> Process:
    return graph.publisher(name, topic, TWIST, field=SPEED, **options)


def report(collector: Process) -> dict[str, Any]:
    found: dict[str, Any] = json.loads(collector.quit()[-1])
    return found


def test_every_message_is_read_as_it_was_published(graph: Graph) -> None:
    collector = graph.collector(WHEEL)
    twists(graph, rate=200, count=300).until(lambda: True, "publisher")
    until_count(collector, 299)
    assert counts(collector) == list(range(300))
    t_us, values = emitted(collector, "wheel")[-1]
    assert abs(t_us / 1e6 - time.time()) < 60
    zeros = {f"{part}.{axis}": 0.0 for part in ("linear", "angular") for axis in "xyz"}
    assert values == {**zeros, COUNT: 299.0}
    counted = report(collector)["/wheel"]
    assert counted == {"messages": 300, "silent": False, "left_out": {}, "qos": "reliable, volatile"}


def test_topics_that_appear_later_are_read_by_name_and_by_pattern(graph: Graph) -> None:
    topics = {**WHEEL, "/sensors/*": {"time": "arrival"}}
    collector = graph.collector(topics)
    collector.until_said("ROS 2 node /iort_agent")
    publishers = [
        twists(graph),
        graph.publisher("imu", "/sensors/imu/raw", FLOAT, field="data"),
        graph.publisher("hidden", "/sensors/_own", FLOAT, field="data", at_once=True),
    ]
    until_count(collector, 20)
    until_count(collector, 20, "sensors-imu-raw", "data")
    assert set(report(collector)) == {"/wheel", "/sensors/imu/raw"}
    assert all(publisher.alive() for publisher in publishers)


@pytest.mark.parametrize("end", ["quit", "kill"])
def test_a_restarted_publisher_is_read_again(graph: Graph, end: str) -> None:
    collector = graph.collector(WHEEL)
    first = twists(graph)
    until_count(collector, 20)
    getattr(first, end)()
    twists(graph, start=1000)
    until_count(collector, 1020)
    found = counts(collector)
    assert found == sorted(set(found))
    assert [count for count in found if count >= 1000][:10] == list(range(1000, 1010))


def test_a_changed_type_is_followed(graph: Graph) -> None:
    collector = graph.collector({"/n": {"stream": "n", "time": "arrival"}})
    first = graph.publisher("pub", "/n", FLOAT, field="data")
    until_count(collector, 5, "n", "data")
    first.quit()
    graph.publisher("pub", "/n", INT, field="data", start=1000)
    until_count(collector, 1005, "n", "data")


def test_two_types_of_one_topic_are_both_read(graph: Graph) -> None:
    collector = graph.collector({"/n": {"stream": "n", "time": "arrival"}})
    graph.publisher("floats", "/n", FLOAT, field="data", count=50)
    graph.publisher("integers", "/n", INT, field="data", start=1000, count=50)
    collector.until(lambda: len(counts(collector, "n", "data")) == 100, "100 samples")
    assert sorted(counts(collector, "n", "data")) == [*range(50), *range(1000, 1050)]


def test_publishers_that_offer_less_are_heard_and_no_reliable_message_is_lost_for_it(graph: Graph) -> None:
    collector = graph.collector(WHEEL)
    twists(graph, "reliable", rate=200, count=1000)
    until_count(collector, 50)
    twists(graph, "unreliable", best_effort=True, start=5000, rate=20)
    collector.until_said("topic /wheel: its publishers offer best_effort, volatile now")
    until_count(collector, 5010)
    collector.until(lambda: counts(collector).count(999) == 1, "the last reliable message")
    assert [count for count in counts(collector) if count < 5000] == list(range(1000))
    assert report(collector)["/wheel"]["qos"] == "best_effort, volatile"


def test_a_publisher_that_offers_less_than_the_settings_demand_is_counted(graph: Graph) -> None:
    settings = {"stream": "wheel", "time": "header", "qos": {"reliability": "reliable"}}
    collector = graph.collector({"/wheel": settings})
    twists(graph, "unreliable", best_effort=True, at_once=True)
    collector.until_said("a publisher does not offer reliable, volatile: it is not heard")
    assert counts(collector) == []
    assert report(collector)["/wheel"]["incompatible_qos"] == 1


def test_the_time_may_be_that_of_the_middleware(graph: Graph) -> None:
    collector = graph.collector({"/n": {"stream": "n", "time": "source"}})
    began_us = time.time_ns() // 1000
    graph.publisher("pub", "/n", FLOAT, field="data", rate=100)
    until_count(collector, 20, "n", "data")
    times = [t_us for t_us, _ in emitted(collector, "n")]
    assert began_us < times[0] < times[-1] < time.time_ns() // 1000
    assert 5_000 < (times[20] - times[0]) / 20 < 50_000


def test_an_rclpy_without_wait_sets_runs_on_its_executor(graph: Graph) -> None:
    file = graph.folder / "executor.json"
    topics = {**WHEEL, "/n": {"stream": "n", "time": "source"}}
    file.write_text(json.dumps({"type": "ros2", "topics": topics}))
    collector = graph.run("executor_collector.py", file)
    twists(graph, rate=100, count=100)
    graph.publisher("floats", "/n", FLOAT, field="data", count=50)
    graph.publisher("integers", "/n", INT, field="data", start=1000, count=50)
    collector.until(lambda: len(counts(collector, "n", "data")) == 100, "both types")
    until_count(collector, 99)
    assert counts(collector) == list(range(100))
    collector.until_said("this rclpy has no wait sets")
    assert report(collector)["/wheel"]["qos"] == "reliable, volatile"


def again(graph: Graph, agent: Agent) -> Agent:
    """The agent, started again in its folder."""
    command = ("iort_agent.cli", "run", "--config", str(agent.folder / "car.yaml"), "--drain-s", "0")
    return Agent(graph.module(*command), agent.folder)


@pytest.mark.parametrize("end", ["terminate", "kill"])
def test_latched_messages_are_stored_once_over_restarts_of_the_agent(
    graph: Graph, tmp_path: Path, end: str
) -> None:
    source = {"type": "ros2", "topics": {"/plan": {"stream": "plan", "time": "source"}}}
    twists(graph, topic="/plan", latch=True, at_once=True, count=1)
    agent = agent_of(graph, tmp_path, source)
    until(lambda: agent.samples("plan") == 1, within_s=WAIT_S)
    assert agent.topic("/plan")["qos"] == "reliable, transient_local"
    # It is remembered once it is in the queue.
    until((tmp_path / "queue.db.latched").exists, within_s=WAIT_S)
    getattr(agent.process, end)()
    agent = again(graph, agent)
    until(lambda: agent.topic("/plan").get("latched_again") == 1, within_s=WAIT_S)
    assert agent.samples("plan") == 0
    twists(graph, "second", topic="/plan", latch=True, at_once=True, count=1, start=7)
    until(lambda: agent.samples("plan") == 1, within_s=WAIT_S)
    assert agent.process.terminate() == 0, "\n".join(agent.process.errors)


def test_arguments_of_ros_are_honoured(graph: Graph, tmp_path: Path) -> None:
    arguments = (
        *("--ros-args", "-r", "__node:=recorder", "-r", "__ns:=/lab"),
        *("-r", "/wheel:=/robot1/wheel", "-p", "use_sim_time:=true"),
    )
    agent = agent_of(graph, tmp_path, {"type": "ros2", "topics": WHEEL}, arguments=arguments)
    agent.process.until_said("ROS 2 node /lab/recorder")
    twists(graph, topic="/robot1/wheel")
    until(lambda: agent.samples("wheel") > 5, within_s=WAIT_S)
    agent.process.until_said("topic /robot1/wheel: geometry_msgs/msg/TwistStamped")
    agent.process.until_said("its time is a simulation's (use_sim_time)")
    assert agent.process.terminate() == 0, "\n".join(agent.process.errors)


def test_a_silent_topic_is_told(graph: Graph) -> None:
    collector = graph.collector(WHEEL)
    twists(graph, count=20)
    collector.until_said("topic /wheel has been silent for 5 s: connected to 1 publisher(s)")
    assert report(collector)["/wheel"]["silent"] is True
