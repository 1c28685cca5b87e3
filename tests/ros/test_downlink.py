"""From the broker to real ROS topics: commands, their leases, and another robot's pose.

What takes an `AnyGraph` also runs in ROS 2, from tests/ros2/test_downlink.py.
"""

from __future__ import annotations

import functools
import json
import os
import signal
import time
import xmlrpc.client
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

from testkit.waiting import until
from tests.ros.conftest import Graph
from tests.ros.process import Process

if TYPE_CHECKING:
    from tests.ros2 import conftest as ros2

    AnyGraph = Graph | ros2.Graph

# The types in either ROS.
TWIST = {1: "geometry_msgs/TwistStamped", 2: "geometry_msgs/msg/TwistStamped"}
POSE_TYPE = {1: "geometry_msgs/PoseStamped", 2: "geometry_msgs/msg/PoseStamped"}
POSE = {"pose": {"position": {"x": 1, "y": 2, "z": 3}, "orientation": {"x": 0, "y": 0, "z": 0, "w": 1}}}


def start(graph: AnyGraph, *arguments: str) -> Process:
    stop = {"twist": {"linear": {"x": 0.0}}}
    drive = {"topic": "/cmd_vel", "type": TWIST[graph.ros], "partial": True}
    settings = {
        "downlink": {
            "cmd": {"drive": {**drive, "motion": {"lease_s": 10, "stop": stop}}},
            "fleet": {"pose": {"topic": "/fleet/{robot}/pose", "type": POSE_TYPE[graph.ros]}},
        },
        "share": {"/pose": {"name": "pose", "rate_hz": 20}},
    }
    process = graph.downlink(settings, *arguments)
    process.until(lambda: "started" in process.lines, "start")
    return process


def heard(listener: Process) -> list[tuple[float, dict[str, Any]]]:
    lines = [line for line in listener.lines if line.startswith("[")]
    return [(at, message) for at, message in map(json.loads, lines)]


def stamp(message: dict[str, Any]) -> float:
    """The time of a message of either ROS."""
    sec, nanosec = message["header"]["stamp"].values()
    return float(sec + nanosec / 1e9)


def has(listener: Process, speed: float) -> bool:
    return speed in speeds(listener)


def speeds(listener: Process) -> list[float]:
    return [message["twist"]["linear"]["x"] for _, message in heard(listener)]


@pytest.fixture
def driven(graph: AnyGraph) -> tuple[Process, Process]:
    downlink = start(graph)
    listener = graph.listener("driver", "/cmd_vel", TWIST[graph.ros])
    connected(downlink)
    listener.until(lambda: "connected" in listener.lines, "connection")
    return downlink, listener


def connected(downlink: Process, topic: str = "/cmd_vel", count: int = 1) -> None:
    before = downlink.lines.count("heard")
    downlink.say(f"await {topic} {count}")
    downlink.until(lambda: downlink.lines.count("heard") > before, "connection")


def drive(downlink: Process, x: float, lease_ms: int = 2_000) -> None:
    downlink.say(f"send {lease_ms} " + json.dumps({"twist": {"linear": {"x": x}}}))


def guarded(graph: AnyGraph) -> tuple[Process, Process]:
    """Return a robot with a guard, and a listener that hears both.

    The guard comes first: rospy may connect a subscriber twice, and lose a message, if a second publisher
    comes while it connects to the first.
    """
    downlink = start(graph, "--guard")
    downlink.say("guard")
    downlink.until(lambda: "guarded" in downlink.lines, "guard")
    listener = graph.listener("driver", "/cmd_vel", TWIST[graph.ros])
    connected(downlink)
    if isinstance(graph, Graph):
        until(lambda: heard_by_guard(graph), "the guard's connection")
    else:
        listener.until(lambda: "publishers 2" in listener.lines, "connection to agent and guard")
    return downlink, listener


def heard_by_guard(graph: Graph) -> bool:
    # A guard that answered late was started again, at another address.
    with suppress(OSError):
        with xmlrpc.client.ServerProxy(graph.environment["ROS_MASTER_URI"]) as master:
            _, _, uri = master.lookupNode("/test", "/iort_agent_guard")
        with xmlrpc.client.ServerProxy(uri) as guard:
            return any(one[4] == "/cmd_vel" for one in guard.getBusInfo("/test")[2])
    return False


def guard_of(downlink: Process) -> int:
    """The process of its guard; a thread starts it again if it answered late."""

    def living() -> list[int]:
        tasks = Path(f"/proc/{downlink.pid}/task").glob("*/children")
        return [child for one in tasks for child in map(int, one.read_text().split()) if not ended(child)]

    (child,) = until(lambda: found if len(found := living()) == 1 else None, "one guard")
    return child


def ended(pid: int) -> bool:
    """Whether a process that is not our child has ended; nobody may have asked for its status."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] == "Z"
    except OSError:
        return True


def drive_on(downlink: Process, listener: Process, x: float, lease_ms: int) -> None:
    """Send the command until it is heard: a guard that answers late is counted as frozen, and started
    again.
    """
    for _ in range(30):
        drive(downlink, x, lease_ms)
        if listener.within(2, lambda: has(listener, x)):
            return
    pytest.fail("no command passed\n" + "\n".join(downlink.errors[-25:]))


def test_a_command_is_published_and_its_lease_ends_in_stops(driven: tuple[Process, Process]) -> None:
    downlink, listener = driven
    sent = time.time()
    drive(downlink, 1.5)
    listener.until(lambda: len(speeds(listener)) == 6, "command and five stops")
    assert speeds(listener) == [1.5, 0, 0, 0, 0, 0]
    came, stop = heard(listener)[1]
    assert int(sent) <= stamp(stop) <= came


def test_a_renewed_lease_does_not_end(driven: tuple[Process, Process]) -> None:
    downlink, listener = driven
    for i in range(1, 21):
        drive(downlink, i, 10_000)
        listener.until(functools.partial(has, listener, i), f"command {i}")
    assert speeds(listener) == list(range(1, 21))


@pytest.mark.parametrize("end", ["cut", "quit"])
def test_a_lost_connection_or_the_agents_end_stops_the_car(driven: tuple[Process, Process], end: str) -> None:
    downlink, listener = driven
    drive(downlink, 1.5, 10_000)
    listener.until(lambda: speeds(listener) == [1.5], "command")
    downlink.say(end)
    listener.until(lambda: len(speeds(listener)) == 6, "five stops")
    assert speeds(listener)[1:] == [0] * 5
    after = [when for when, _ in heard(listener)]
    assert after[1] - after[0] < 10, "the car must stop before the lease ends"


@pytest.mark.parametrize(("end", "lease_s"), [(signal.SIGKILL, 10), (signal.SIGSTOP, 5)])
def test_a_killed_and_a_frozen_agent_are_stopped_by_the_guard(
    graph: AnyGraph, end: signal.Signals, lease_s: int
) -> None:
    downlink, listener = guarded(graph)
    drive_on(downlink, listener, 1.5, lease_s * 1000)
    downlink.signal(end)
    listener.until(lambda: speeds(listener)[-5:] == [0] * 5, "five stops of the guard")
    moved = speeds(listener).index(0)
    assert speeds(listener) == [1.5] * moved + [0] * 5
    drove, stopped = (stamp(message) for _, message in heard(listener)[moved - 1 : moved + 1])
    if end == signal.SIGKILL:
        assert stopped - drove < lease_s, "it does not wait for the lease's end"
    else:
        assert stopped - drove > lease_s - 0.1, "the lease holds to its end"
    downlink.signal(signal.SIGCONT)


@pytest.mark.parametrize("end", [signal.SIGKILL, signal.SIGSTOP])
def test_an_emergency_stop_outlives_a_killed_and_a_frozen_agent(graph: AnyGraph, end: signal.Signals) -> None:
    downlink, listener = guarded(graph)
    downlink.say("stop")
    listener.until(lambda: has(listener, 0), "the stop")
    guard = guard_of(downlink)
    downlink.signal(end)
    before = len(speeds(listener))
    # Longer than the guard looks for an agent that is back: in ROS 2 a killed one is still in the graph.
    listener.until(lambda: len(speeds(listener)) > before + 50, "the guard's stops for five seconds")
    if end == signal.SIGKILL:
        downlink = start(graph, "--guard")
        downlink.say("guard")
        downlink.until(lambda: "guarded" in downlink.lines, "the guard of the agent that is back")
        until(lambda: ended(guard), "the guard of the agent that died to leave")
    downlink.signal(signal.SIGCONT)
    # An agent that was killed now would leave its guard.
    downlink.say("quit")
    downlink.until(lambda: downlink.lines[-1].startswith("["), "the end")
    assert set(speeds(listener)) == {0}


def test_a_guard_that_dies_is_started_again_and_nothing_moves_meanwhile(graph: AnyGraph) -> None:
    downlink, listener = guarded(graph)
    child = guard_of(downlink)
    if isinstance(graph, Graph):
        # The next guard cannot join before the test has seen the refusal. In ROS 2 it takes a second.
        graph.master.signal(signal.SIGSTOP)
    os.kill(child, signal.SIGKILL)
    downlink.until_said("the guard died: motion is refused until it runs again")
    drive(downlink, 0.5)
    downlink.until_said("rejected: guard not ready")
    if isinstance(graph, Graph):
        graph.master.signal(signal.SIGCONT)
    downlink.say("guard")
    downlink.until(lambda: downlink.lines.count("guarded") == 2, "guard")
    drive_on(downlink, listener, 1.5, 2_000)
    assert not has(listener, 0.5)


def test_an_invalid_message_is_rejected(driven: tuple[Process, Process]) -> None:
    downlink, listener = driven
    downlink.say('send 300 {"twist": {"linear": {"x": "fast"}}}')
    downlink.until_said("twist.linear.x: must be a number, got 'fast'")
    drive(downlink, 2.5)
    listener.until(lambda: 2.5 in speeds(listener), "command")
    assert speeds(listener)[0] == 2.5


def test_a_command_is_not_kept_for_a_late_subscriber(
    graph: AnyGraph, driven: tuple[Process, Process]
) -> None:
    downlink, listener = driven
    drive(downlink, 1.5)
    listener.until(lambda: has(listener, 1.5), "command")
    late = graph.listener("late", "/cmd_vel", TWIST[graph.ros])
    connected(downlink, count=2)
    late.until(lambda: "connected" in late.lines, "connection")
    drive(downlink, 2.5)
    late.until(lambda: has(late, 2.5), "command")
    assert 1.5 not in speeds(late)


def test_another_robots_pose_appears_as_a_topic(graph: AnyGraph) -> None:
    downlink = start(graph)
    downlink.say("pose car-2 " + json.dumps(POSE))
    listener = graph.listener("map", "/fleet/car_2/pose", POSE_TYPE[graph.ros])
    connected(downlink, "/fleet/car_2/pose")
    listener.until(lambda: "connected" in listener.lines, "connection")
    downlink.say("pose car-2 " + json.dumps(POSE))
    listener.until(lambda: heard(listener), "pose")
    assert heard(listener)[0][1]["pose"]["position"] == {"x": 1, "y": 2, "z": 3}


def test_commands_still_arrive_after_a_restart_of_the_master(
    graph: Graph, driven: tuple[Process, Process]
) -> None:
    downlink, first = driven
    graph.master.kill()
    downlink.until_said("does not answer")
    graph.start_master()
    downlink.until_said("had forgotten /pose, /cmd_vel: registered again")
    second = graph.listener("another", "/cmd_vel", TWIST[1])
    connected(downlink, count=2)
    drive(downlink, 1.5)
    for listener in (first, second):
        listener.until(functools.partial(has, listener, 1.5), "command")
    report, _ = json.loads(downlink.quit()[-1])
    assert report["commands"]["drive"]["passed"] == 1
