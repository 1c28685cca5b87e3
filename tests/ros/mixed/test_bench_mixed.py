"""The bench's mixed robot drives on a real graph, and the bench measures both recorders."""

from __future__ import annotations

import shutil

import pytest

from bench.floors import mosquitto
from bench.ros.mixed_robot import topics
from bench.sections import mixed


def test_both_recorders_record_the_mixed_robot(ros_python: str) -> None:
    program = mosquitto.found()
    if program is None or shutil.which("rosbag") is None:
        pytest.skip("the mixed robot needs more: apt install mosquitto python3-rosbag")
    found = mixed.measure(program, ros_python, 2, lambda _: None)
    assert set(found.published) == set(topics())
    assert found.published["/map"] == 1
    assert found.published["/joint_states"] == 2 * found.published["/sensors/core"], (
        "the topic has two publishers"
    )
    # On a busy machine `rosbag record` misses some of the fastest messages; the bench reports how many.
    assert set(found.recorded) == set(found.published)
    assert all(0 < count <= found.published[name] for name, count in found.recorded.items())
    for name in ("/sensors/core", "/odom", "/diagnostics"):
        assert found.arrived[name] == found.published[name]
    assert 0 < found.bag_bz2_bytes < found.bag_bytes
    assert all(usage.cpu_s > 0 for usage in found.used.values())
