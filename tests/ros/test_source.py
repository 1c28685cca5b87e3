"""The ros1 source in a real graph: rospy publishers of types that the agent's Python does not know."""

from __future__ import annotations

import itertools
import json
import time
from typing import Any

import pytest

from tests.ros.conftest import Graph
from tests.ros.process import Process
from tests.unit.contract.ros.ros_values import HEADER, RULE

WHEEL = f"""# A type that nobody has installed.
uint8 LEFT=0
Header header
WheelState state
{HEADER}{RULE}
MSG: strange_msgs/WheelState
int32 turns        # whole ones
string name
float32[2] load
Bearing[] bearings
duration since
{RULE}
MSG: strange_msgs/Bearing
float64 wear
"""
WHEEL_2 = WHEEL.replace("string name", "string name\nbool locked")


class Cars:
    """Publishers and the collector in one graph."""

    def __init__(self, graph: Graph) -> None:
        self.graph = graph
        self._numbers = itertools.count()

    def publisher(
        self,
        name: str,
        definition: str = WHEEL,
        topic: str = "/wheel",
        flags: tuple[str, ...] = (),
        **options: Any,
    ) -> Process:
        file = self.graph.folder / f"{name}.msg"
        file.write_text(definition)
        arguments = [*flags, *(part for key, value in options.items() for part in (f"--{key}", value))]
        return self.graph.run(
            "publisher.py", name, topic, "strange_msgs/Wheel", file, "--field", "state.turns", *arguments
        )

    def collector(self, *topics: str, **settings: Any) -> Process:
        # A file of its own: an earlier collector may be reading the other.
        file = self.graph.folder / f"source{next(self._numbers)}.json"
        each = {"time": "header", **settings}
        file.write_text(json.dumps({"topics": {t: {"stream": t[1:], **each} for t in topics or ("/wheel",)}}))
        return self.graph.run("collector.py", file)


@pytest.fixture
def cars(graph: Graph) -> Cars:
    return Cars(graph)


def emitted(collector: Process, stream: str) -> list[list[Any]]:
    """Return the lines of the collector's samples; rospy prints lines of its own."""
    found = [json.loads(line) for line in list(collector.lines) if line.startswith("[")]
    return [one for one in found if one[0] == stream]


def samples(collector: Process, stream: str = "wheel") -> list[tuple[int, dict[str, Any]]]:
    return [(one[1], one[2]) for one in emitted(collector, stream)]


def turns(collector: Process, stream: str = "wheel") -> list[int]:
    return [values["turns"] for _, values in samples(collector, stream)]


def until_turns(collector: Process, least: int, stream: str = "wheel") -> None:
    collector.until(lambda: max(turns(collector, stream), default=-1) >= least, f"turn {least} of {stream}")


def test_every_message_of_an_unknown_type_is_read(cars: Cars) -> None:
    collector = cars.collector()
    cars.publisher("pub", rate=200, count=300).until(lambda: True, "publisher")
    until_turns(collector, 299)
    report = json.loads(collector.quit()[-1])
    assert turns(collector) == list(range(300))
    assert report["/wheel"] == {"messages": 300, "silent": False, "left_out": {}}
    t_us, values = samples(collector)[-1]
    assert abs(t_us / 1e6 - time.time()) < 60
    assert values == {
        "turns": 299, "name": "", "load.0": 0.0, "load.1": 0.0, "since.sec": 0, "since.nanosec": 0,
    }  # fmt: skip


def test_the_source_survives_a_late_and_a_restarted_master(cars: Cars) -> None:
    cars.graph.master.kill()
    collector = cars.collector("/wheel", "/other")
    collector.until_said("no ROS master at")
    cars.graph.start_master()
    cars.publisher("pub", rate=50)
    until_turns(collector, 20)
    cars.graph.master.kill()
    collector.until_said("does not answer")
    cars.graph.start_master()
    collector.until_said("had forgotten /wheel, /other: registered again")
    # The source finds a publisher from after the restart, and the earlier publisher was never interrupted.
    cars.publisher("second", topic="/other")
    until_turns(collector, 20, "other")
    found = turns(collector)
    assert found == list(range(len(found)))


@pytest.mark.parametrize("end", ["quit", "kill"])
def test_a_restarted_publisher_is_read_again(cars: Cars, end: str) -> None:
    collector = cars.collector()
    first = cars.publisher("pub")
    until_turns(collector, 20)
    getattr(first, end)()
    cars.publisher("pub", start=1000)
    until_turns(collector, 1020)
    found = turns(collector)
    assert found == sorted(set(found))
    assert [turn for turn in found if turn >= 1000][:10] == list(range(1000, 1010))


def test_a_changed_definition_is_followed(cars: Cars) -> None:
    collector = cars.collector()
    first = cars.publisher("pub")
    until_turns(collector, 5)
    first.quit()
    cars.publisher("pub", WHEEL_2, start=1000)
    until_turns(collector, 1005)
    fields = [("locked" in values, values["turns"] >= 1000) for _, values in samples(collector)]
    assert all(new == later for new, later in fields)


def test_two_publishers_of_one_topic_may_have_two_definitions(cars: Cars) -> None:
    collector = cars.collector()
    cars.publisher("one", count=50)
    cars.publisher("two", WHEEL_2, start=1000, count=50)
    collector.until(lambda: len(turns(collector)) == 100, "100 samples")
    assert sorted(turns(collector)) == [*range(50), *range(1000, 1050)]


def test_use_sim_time_is_detected_while_running(cars: Cars) -> None:
    collector = cars.collector()
    cars.publisher("pub")
    until_turns(collector, 5)
    cars.graph.parameter("/use_sim_time", True)
    collector.until_said("use_sim_time")
