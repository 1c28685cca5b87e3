"""The node's name: two nodes of one name, where the later waits, and the command line's remappings."""

from __future__ import annotations

import json
import xmlrpc.client
from contextlib import suppress
from pathlib import Path

from testkit.waiting import until
from tests.ros.agents import agent_of
from tests.ros.conftest import Graph
from tests.ros.process import WAIT_S, Process
from tests.ros.test_downlink import connected, drive, has, start
from tests.ros.test_source import Cars, turns, until_turns

WAITS = "another node is called /iort_agent at http://127.0.0.1:"
WHEELS = {"type": "ros1", "topics": {"/wheel": {"stream": "wheel", "time": "header"}}}


def test_a_second_node_waits_until_the_first_has_ended(graph: Graph) -> None:
    cars = Cars(graph)
    cars.publisher("pub")
    first = cars.collector()
    until_turns(first, 5)
    second = cars.collector()
    second.until_said(WAITS)
    until_turns(first, max(turns(first)) + 50)
    assert turns(second) == []
    assert second.alive()
    # A killed node stays registered at the master; this has no effect.
    first.kill()
    until_turns(second, max(turns(first)) + 1)
    assert "waits" not in json.loads(second.quit()[-1])


def test_a_node_takes_its_lost_name_again_when_it_is_free(graph: Graph) -> None:
    cars = Cars(graph)
    cars.publisher("pub")
    collector = cars.collector()
    until_turns(collector, 5)
    for i in range(2):
        # Another program takes the name without asking.
        taker = cars.publisher("iort_agent", topic=f"/elsewhere{i}")
        collector.until(lambda i=i: said(collector, WAITS) > i, "waiting")
        taker.kill()
        until_turns(collector, max(turns(collector)) + 50)
    assert said(collector, "another node took the name /iort_agent") == 2
    collector.quit()


def test_one_of_two_simultaneous_nodes_waits_and_neither_ends(graph: Graph) -> None:
    cars = Cars(graph)
    cars.publisher("pub")
    both = [cars.collector() for _ in range(2)]

    def settled() -> bool:
        """Whether one has the name and all messages during 200 of them."""
        holder, before = registered(graph, "/iort_agent"), [newest(one) for one in both]
        until(lambda: newest(*both) >= max(before) + 200, within_s=WAIT_S)
        heard = [newest(one) > n for one, n in zip(both, before, strict=True)]
        return heard.count(True) == 1 and registered(graph, "/iort_agent") == holder

    until(settled, within_s=WAIT_S)
    assert sum(said(one, WAITS) for one in both) >= 1
    assert [one.alive() for one in both] == [True, True]


def test_a_shut_down_node_ends_the_source(graph: Graph) -> None:
    cars = Cars(graph)
    cars.publisher("pub")
    collector = cars.collector()
    until_turns(collector, 5)
    with (
        xmlrpc.client.ServerProxy(registered(graph, "/iort_agent")) as node,
        # It may end before its answer is written.
        suppress(OSError),
    ):
        node.shutdown("/rosnode-1-2", "user request")
    collector.until_said("the ROS node /iort_agent has ended: it was shut down from outside")


def test_the_status_names_the_waiting_source_and_other_sources_continue(graph: Graph, tmp_path: Path) -> None:
    taker = graph.run("listener.py", "iort_agent", "/elsewhere", "std_msgs/Float64")
    until(lambda: registered(graph, "/iort_agent"), within_s=WAIT_S)
    agent = agent_of(graph, tmp_path, WHEELS, {"type": "sim"})
    (alarm,) = until(agent.waits, within_s=WAIT_S)
    assert alarm.startswith(f"source waits: {WAITS}")
    assert alarm.endswith("set sources[].node")
    before = agent.samples("vesc")
    until(lambda: agent.samples("vesc") > before, within_s=WAIT_S)
    taker.kill()
    until(lambda: agent.waits() == [], within_s=WAIT_S)
    assert agent.process.terminate() == 0, "\n".join(agent.process.errors)


def test_roslaunch_arguments_are_honoured(graph: Graph, tmp_path: Path) -> None:
    master = graph.environment.pop("ROS_MASTER_URI")
    arguments = (
        f"__master:={master}", "__name:=recorder", f"__log:={tmp_path}/recorder-1.log", "__ns:=/lab",
        "__ip:=127.0.0.1", "wheel:=/robot1/wheel", "/wheel:=/robot1/wheel", "_rate:=5",
    )  # fmt: skip
    agent = agent_of(graph, tmp_path, WHEELS, arguments=arguments)
    graph.environment["ROS_MASTER_URI"] = master
    agent.process.until_said("_rate:=5 is ignored")
    Cars(graph).publisher("pub", topic="/robot1/wheel")
    until(lambda: agent.samples("wheel") > 5, within_s=WAIT_S)
    assert registered(graph, "/lab/recorder").startswith("http://127.0.0.1:")
    assert registered(graph, "/iort_agent") == ""
    # Its log line has the topic's name in the graph.
    agent.process.until_said("topic /robot1/wheel: strange_msgs/Wheel")
    # It registers at a restarted master by that name, too.
    graph.master.kill()
    agent.process.until_said("does not answer")
    graph.start_master()
    agent.process.until_said("had forgotten /robot1/wheel: registered again")
    assert agent.process.terminate() == 0, "\n".join(agent.process.errors)


def test_commands_and_shares_are_remapped(graph: Graph) -> None:
    downlink = start(graph, "/cmd_vel:=/robot1/cmd_vel")
    listener = graph.run("listener.py", "driver", "/robot1/cmd_vel", "geometry_msgs/TwistStamped")
    connected(downlink, "/robot1/cmd_vel")
    drive(downlink, 1.5)
    listener.until(lambda: has(listener, 1.5), "command")


def newest(*collectors: Process) -> int:
    return max(turn for one in collectors for turn in [-1, *turns(one)])


def said(process: Process, text: str) -> int:
    return sum(text in line for line in process.errors)


def registered(graph: Graph, name: str) -> str:
    """Return the address of the node that the master knows by a name."""
    with xmlrpc.client.ServerProxy(graph.environment["ROS_MASTER_URI"]) as master:
        _, _, uri = master.lookupNode("/test", name)
    return str(uri)
