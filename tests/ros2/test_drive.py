"""From the page's stick to a foreign node: a Twist, which ends with the lease when the page dies."""

from __future__ import annotations

import json
from contextlib import suppress
from typing import TYPE_CHECKING, Any

from playwright.sync_api import Error

from iort_contract.catalog.streams import LOG_STREAM
from iort_contract.catalog.vesc import VESC_STREAM
from iort_station import data
from iort_station.operations import audit
from iort_station.page import answers as control
from iort_station.page import motion
from iort_station.page.answers import actions, answers
from iort_station.page.server import PageServer
from testkit.waiting import until
from tests.local.conftest import bundle, embedded  # noqa: F401 - fixtures
from tests.local.robots.test_drive_page import hold

if TYPE_CHECKING:
    from collections.abc import Callable

    from playwright.sync_api import Page

    from iort_station.cloud import Cloud
    from iort_station.fleet.robots import Bundle
    from local.cloud import EmbeddedCloud
    from tests.ros.process import Process
    from tests.ros2.conftest import Graph

TWIST = "geometry_msgs/msg/Twist"
LEASE_S = 0.5
DOWNLINK = {
    "cmd": {
        "drive": {
            "topic": "/cmd_vel",
            "type": TWIST,
            "partial": True,
            "motion": {"lease_s": LEASE_S, "stop": {"linear": {"x": 0.0}}},
        }
    },
    "drive": {"speed": "linear.x", "steering": "angular.z", "max_speed_mps": 1.5},
}
# What a busy machine may add to the way of a message.
_SLOW_S = 0.5


def twists(listener: Process) -> list[tuple[float, float]]:
    """When each Twist came, and its speed."""
    heard: list[tuple[float, dict[str, Any]]] = [
        json.loads(line) for line in list(listener.lines) if line.startswith("[")
    ]
    return [(at, message["linear"]["x"]) for at, message in heard]


def logged(cloud: Cloud, robot: str) -> str:
    """The agent's log, as far as the cloud has it."""
    if not list(audit.batches(cloud, robot, LOG_STREAM)):
        return ""
    lines = data.query(cloud, robot, LOG_STREAM, "-1h", "now").columns
    return "\n".join(str(text) for column in lines.values() for text in column)


def test_a_twist_from_the_page_reaches_a_foreign_node_and_ends_when_the_page_dies(
    embedded: EmbeddedCloud,  # noqa: F811 - the fixture
    bundle: Callable[..., Bundle],  # noqa: F811 - the fixture
    open_page: Callable[..., Page],
    graph: Graph,
) -> None:
    cloud = embedded.cloud
    # The page drives by what it sees, so something must be there to be seen.
    sources = [
        {"type": "sim", "stream": VESC_STREAM, "rate_hz": 50},
        {"type": "ros2", "topics": {"/odom": {"stream": "odom", "time": "arrival"}}},
    ]
    car = bundle(sources=sources, ping={"rate_hz": 5}, downlink=DOWNLINK)
    agent = graph.module("iort_agent.cli", "run", "--config", car.config, "--drain-s", 0)
    listener = graph.listener("motor", "/cmd_vel", TWIST)
    agent.until_said("connected to")
    listener.until(lambda: "publishers 2" in listener.lines, "connection to agent and guard")
    with PageServer(
        namespace=cloud.namespace,
        **motion.reaching(cloud, "iot"),
        answers=answers(cloud),
        open_actions=actions(cloud),
        actions=control.keyed_actions(cloud),
    ) as server:
        page = open_page(server.invitation(f"#/car/{car.robot}"))
        page.get_by_role("button", name="Take the wheel").click()

        def drives() -> bool:
            hold(page)
            page.keyboard.down("w")
            return bool(listener.within(2, lambda: max((x for _, x in twists(listener)), default=0) > 0.2))

        until(drives, "the car to be driven")
        # The renderer's end: it sends no farewell.
        with suppress(Error):
            page.goto("chrome://crash", timeout=2000)
        listener.until(lambda: [x for _, x in twists(listener)][-5:] == [0.0] * 5, "the lease's end")
    heard = twists(listener)
    last = max(i for i, (_, speed) in enumerate(heard) if speed)
    assert len(heard) - last - 1 >= 5
    assert heard[last + 1][0] - heard[last][0] < LEASE_S + _SLOW_S
    until(lambda: "nobody renews it, stopping" in logged(cloud, car.robot), "the agent's log in the cloud")
    assert agent.terminate() == 0, "\n".join(agent.errors)
