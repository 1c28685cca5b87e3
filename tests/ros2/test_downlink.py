"""From the broker to real ROS 2 topics: what tests/ros/test_downlink.py holds over ROS 1 holds here, too."""

from __future__ import annotations

import functools
import signal

from tests.ros.process import Process
from tests.ros.test_downlink import (  # noqa: F401 - collected here, with the graph of this folder
    TWIST,
    connected,
    drive,
    drive_on,
    driven,
    has,
    heard,
    start,
    test_a_command_is_not_kept_for_a_late_subscriber,
    test_a_command_is_published_and_its_lease_ends_in_stops,
    test_a_guard_that_dies_is_started_again_and_nothing_moves_meanwhile,
    test_a_killed_and_a_frozen_agent_are_stopped_by_the_guard,
    test_a_lost_connection_or_the_agents_end_stops_the_car,
    test_a_renewed_lease_does_not_end,
    test_an_emergency_stop_outlives_a_killed_and_a_frozen_agent,
    test_an_invalid_message_is_rejected,
    test_another_robots_pose_appears_as_a_topic,
)
from tests.ros2.conftest import Graph


def test_the_guard_takes_the_agents_namespace_and_remappings(graph: Graph) -> None:
    rules = ["__ns:=/lab", "recorder:/cmd_vel:=/mux/cmd_vel", "__node:=recorder"]
    downlink = start(graph, "--guard", "--ros-args", *(part for rule in rules for part in ("-r", rule)))
    downlink.say("guard")
    downlink.until(lambda: "guarded" in downlink.lines, "guard")
    listener = graph.listener("driver", "/mux/cmd_vel", TWIST[2])
    connected(downlink)
    listener.until(lambda: "publishers 2" in listener.lines, "connection to agent and guard")
    drive_on(downlink, listener, 1.5, 10_000)
    downlink.signal(signal.SIGKILL)
    listener.until(functools.partial(has, listener, 0), "the guard's stop")


def test_a_frozen_subscriber_delays_no_command_and_no_stop(
    graph: Graph,
    driven: tuple[Process, Process],  # noqa: F811 - the fixture
) -> None:
    downlink, listener = driven
    frozen = graph.listener("frozen", "/cmd_vel", TWIST[2])
    connected(downlink, count=2)
    frozen.signal(signal.SIGSTOP)
    # More than the middleware keeps for it.
    for i in range(1, 101):
        drive(downlink, i, 1_000)
        listener.until(functools.partial(has, listener, i), f"command {i}")
    listener.until(functools.partial(has, listener, 0), "stop")
    times = {message["twist"]["linear"]["x"]: at for at, message in reversed(heard(listener))}
    assert 0.5 < times[0] - times[100] < 1.5
    frozen.signal(signal.SIGCONT)
