"""A robot with video, and the loop of its viewers."""

from __future__ import annotations

import pytest

from iort_agent.video import signalling
from testkit.waiting import GUARD_S
from tests.unit.agent.video.rig import Loop, Rig


@pytest.fixture
def loop(socket_enabled):
    loop = Loop()
    yield loop
    loop.close()


@pytest.fixture
def make_rig(socket_enabled, monkeypatch):
    """Makes robots with settings of car.yaml's section video."""
    for name in ("GATHER_S", "CONNECT_S"):
        monkeypatch.setattr(signalling, name, GUARD_S)
    rigs = []

    def make(**settings):
        rigs.append(Rig(**settings))
        rigs[-1].start()
        return rigs[-1]

    yield make
    for rig in rigs:
        rig.close()


@pytest.fixture
def rig(make_rig):
    return make_rig()
