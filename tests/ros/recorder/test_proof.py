"""No incident without its data: ten windows at 1 kHz of small and 30 Hz of 100 KB messages, in either ROS.

Meanwhile, the agent is killed, the network and the disk fail, clocks are set back, and publishers and the
master start again. Every message of a window, by its publisher's own record, is in the incident's file of the
bucket, or the file itself says why not. IORT_RECORDER_S sets the duration, see `make prove-recorder`.
"""

from __future__ import annotations

import os
import subprocess
from collections.abc import Iterator
from typing import Any

import pytest
from rosbags.highlevel import AnyReader

from iort_contract.messages.recorder import OVER_BUDGET, UPLOADED
from local.cloud import EmbeddedCloud
from testkit.proxy import Proxy
from testkit.ros2 import ABSENT, Ros2Error, find
from tests.foxglove import opened
from tests.local.conftest import embedded  # noqa: F401 - a fixture
from tests.ros.conftest import Graph as Graph1
from tests.ros.recorder.drive import BUDGET_MB, COOLDOWN_S, EVERY_S, Drive
from tests.ros.recorder.robot import Robot, small_disk
from tests.ros2.conftest import Graph as Graph2

pytestmark = pytest.mark.heavy

DURATION_S = float(os.environ.get("IORT_RECORDER_S") or 60)


@pytest.fixture(scope="module", params=[1, 2], ids=["ros1", "ros2"])
def drive(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Drive]:
    folder = tmp_path_factory.mktemp(f"recorder{request.param}")
    graph: Any
    if request.param == 1:
        graph = Graph1(request.getfixturevalue("ros_python"), folder)
        graph.start_master()
    else:
        try:
            graph = Graph2(find(), folder)
        except Ros2Error as error:
            if str(error) == ABSENT:
                pytest.skip(ABSENT)
            raise
    try:
        cloud: EmbeddedCloud = request.getfixturevalue("embedded")
        with Proxy("127.0.0.1", cloud.cloud.mqtt_port) as proxy, small_disk(folder / "disk") as disk:
            found = Drive(Robot(graph, cloud, proxy, disk), DURATION_S)
            found.run()
        with request.config.pluginmanager.getplugin("capturemanager").global_and_fixture_disabled():
            print(f"\nROS {request.param}\n{found.report()}")  # noqa: T201 - the proof's result
        yield found
    finally:
        graph.stop()


def test_every_window_has_every_message_or_says_why_not(drive: Drive) -> None:
    assert len(drive.windows) >= 7
    assert [one for one in drive.windows if one.unexplained or not one.kept] == []


def test_every_window_begins_with_the_latched_message(drive: Drive) -> None:
    assert [one for one in drive.windows if not one.latched] == []


def test_windows_that_overlap_are_one_file(drive: Drive) -> None:
    assert {one.name: one.edges for one in drive.windows}["two that overlap"] == 2


def test_a_foreign_reader_recovers_the_ring_of_a_killed_agent(drive: Drive) -> None:
    assert drive.recovered >= drive.written > 0


def test_cooldown_and_budget_hold(drive: Drive) -> None:
    # Each costs a busy machine more than that; some demands are not seen as edges of their own.
    assert drive.edges >= drive.burst_s / EVERY_S / 2
    kept = [one for one in drive.burst if one.state == UPLOADED]
    assert sum(one.bytes for one in kept) <= BUDGET_MB * 1e6
    assert len(drive.burst) <= drive.burst_s / COOLDOWN_S + 2
    assert any(one.state == OVER_BUDGET for one in drive.burst)


def test_others_open_every_incident(drive: Drive) -> None:
    for one in drive.windows:
        assert sum(map(len, opened(one.path, without=True).messages.values())) == one.kept
        if drive.robot.graph.ros == 2:
            with AnyReader([one.path]) as reader:
                assert sum(1 for _ in reader.messages()) == one.kept
            if drive.robot.graph.ros2.has("ros2bag") and drive.robot.graph.ros2.has("rosbag2_storage_mcap"):
                info = subprocess.run(
                    ["ros2", "bag", "info", str(one.path)],
                    env=drive.robot.graph.environment, capture_output=True, text=True, check=False,
                )  # fmt: skip
                assert f"Messages:          {one.kept}" in info.stdout, info.stdout + info.stderr
