"""A ROS node asks the cloud by a service and by a topic, of the real graph.

What takes an `AnyGraph` also runs in ROS 2, from tests/ros2/test_asks.py.
"""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

from tests.ros.conftest import Graph
from tests.ros.process import Process

if TYPE_CHECKING:
    from tests.ros.test_downlink import AnyGraph


def start(graph: AnyGraph, **ask: Any) -> tuple[Process, Process]:
    """The agent's downlink, and a node that has found its service."""
    downlink = graph.downlink({"downlink": {"ask": {"calibration": ask}}})
    caller = graph.run("caller.py", "planner", "calibration")
    caller.until(lambda: "found" in caller.lines, "service")
    return downlink, caller


def answers(caller: Process, count: int) -> list[Any]:
    caller.until(lambda: len(caller.lines) > count, f"{count} answers")
    return [json.loads(line) for line in caller.lines[1:]]


def test_a_node_calls_the_service_and_gets_the_answer(graph: AnyGraph) -> None:
    _, caller = start(graph, body={"last": 1})
    caller.say("")
    ((success, message),) = answers(caller, 1)
    assert (success, json.loads(message)) == (True, {"asked": {"last": 1}})


def test_a_refusal_is_no_success_and_says_why(graph: AnyGraph) -> None:
    _, caller = start(graph)
    caller.say("")
    assert answers(caller, 1) == [[False, "no_data: nothing yet"]]


def test_a_topic_takes_bodies_and_another_has_the_answers(graph: AnyGraph) -> None:
    downlink, caller = start(graph)
    caller.say('{"last": 2}')
    assert answers(caller, 1) == [{"body": {"asked": {"last": 2}}}]
    caller.quit()
    report, _ = json.loads(downlink.quit()[-1])
    assert report["asked"] == {"calibration": {"answered": 1}}


def test_the_service_is_there_again_after_a_restart_of_the_master(graph: Graph) -> None:
    downlink, caller = start(graph, body={"last": 3})
    graph.master.kill()
    downlink.until_said("does not answer")
    graph.start_master()
    downlink.until_said("had forgotten")
    again = graph.run("caller.py", "another", "calibration")
    again.until(lambda: "found" in again.lines, "service")
    again.say("")
    assert answers(again, 1)[0][0] is True
    caller.kill()
