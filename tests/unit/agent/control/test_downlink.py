"""Which ROS graph the commands, peers and questions of a configuration join."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from iort_agent.common.schema import Place, load
from iort_agent.control import guard
from iort_agent.control.commands import Operator
from iort_agent.control.config import DownlinkConfig
from iort_agent.control.downlink import make_downlink
from iort_agent.mqtt.dispatch import Dispatcher
from iort_agent.sources import SourceConfig
from iort_agent.sources.registry import SOURCES
from iort_contract.limits import ContractError
from testkit.agent import Loopback, ManualClock, link_of
from tests.unit.agent.control.downlink_rig import FakeGraph

TYPES = {1: "std_msgs/Float64", 2: "std_msgs/msg/Float64"}
PLACE = Place(Path("car.yaml"))


def source(ros: int, node: str = "iort_agent") -> SourceConfig:
    topics = {"/pose": {"stream": "pose", "time": "arrival"}}
    return load(SOURCES[f"ros{ros}"], {"topics": topics, "node": node}, PLACE)


def config(*types: int, topic: str = "/speed") -> DownlinkConfig:
    cmd = {f"cmd{i}": {"topic": f"{topic}{i}", "type": TYPES[ros]} for i, ros in enumerate(types)}
    return load(DownlinkConfig, {"cmd": cmd} if cmd else {}, PLACE)


@pytest.mark.parametrize(
    ("sources", "types", "environment", "found"),
    [
        ([source(1)], [1, 1], "2", (1, "iort_agent")),
        ([source(2, "car")], [2], "1", (2, "car")),
        ([], [1], "2", (1, None)),
        ([], [2], "1", (2, None)),
        ([source(1, "one"), source(2, "two")], [1], "2", (1, "one")),
        ([source(1, "one"), source(2, "two")], [2], "1", (2, "two")),
        # Questions and shares have no types.
        ([source(2)], [], "1", (2, "iort_agent")),
        ([source(1, "one"), source(2, "two")], [], "1", (2, "two")),
        ([], [], "1", (1, None)),
        ([], [], "2", (2, None)),
        ([], [], "", (1, None)),
    ],
)
def test_the_sources_and_the_types_decide(
    sources: Any, types: list[int], environment: str, found: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("ROS_VERSION", environment)
    assert config(*types).graph(sources) == found


@pytest.mark.parametrize(
    ("sources", "types", "error"),
    [
        ([source(1)], [1, 2], "cmd.cmd1.type must be std_msgs/Float64, as the graph is of ROS 1"),
        ([source(2)], [1], "cmd.cmd0.type must be std_msgs/msg/Float64, as the graph is of ROS 2"),
        ([source(1), source(2)], [2, 1], "cmd.cmd1.type must be std_msgs/msg/Float64"),
        ([], [1, 2], "cmd.cmd0.type must be std_msgs/msg/Float64"),
    ],
)
def test_a_type_of_the_other_ros_is_an_error_that_says_the_right_one(
    sources: Any, types: list[int], error: str
) -> None:
    with pytest.raises(ContractError, match=error):
        config(*types).graph(sources)


def test_a_topic_that_ros2_does_not_allow_is_an_error() -> None:
    assert config(1, topic="/motor/1").graph([]) == (1, None)
    with pytest.raises(ContractError, match=r"cmd\.cmd0\.topic must have no part that begins with a digit"):
        config(2, topic="/motor/1").graph([])


@pytest.mark.parametrize("ros", [1, 2])
def test_commands_and_guard_join_the_graph_of_the_source(ros: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(FakeGraph, "ros", ros)
    joined: list[str] = []

    def join(name: str, _clock: Any) -> Any:
        joined.append(name)
        return FakeGraph()

    monkeypatch.setitem(guard.NODES, ros, join)
    clock = ManualClock()
    motion = {"topic": "/speed", "type": TYPES[ros], "motion": {"stop": {"data": 0.0}}}
    downlink = make_downlink(
        load(DownlinkConfig, {"cmd": {"speed": motion}}, PLACE),
        (),
        link=link_of(Loopback(clock, Dispatcher()), clock),
        boot="0badcafe",
        sources=[source(ros, "car")],
        graph=None,
        offset=lambda: None,
        operator=Operator(lambda *_: None, lambda _: None, lambda: True),
    )
    assert downlink is not None
    assert joined == ["car"]
    assert downlink._guard is not None
    assert f'"agent":"{FakeGraph.base}","ros":{ros}' in downlink._guard._first.decode()
