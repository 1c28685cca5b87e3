"""Commands, peers, questions and the guard are held in the form of ROS 1 and in that of ROS 2."""

from __future__ import annotations

import pytest

from tests.unit.agent.control.downlink_rig import FakeGraph


@pytest.fixture(params=[1, 2], ids=["ros1", "ros2"])
def ros(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> int:
    """The ROS of the graph in memory."""
    number: int = request.param
    monkeypatch.setattr(FakeGraph, "ros", number)
    return number
