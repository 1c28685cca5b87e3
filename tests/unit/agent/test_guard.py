"""The guard's process, seen from the agent: motion is refused without it, and nothing waits for it."""

from __future__ import annotations

import os
import select
import subprocess
from typing import Any

import pytest

from iort_agent.control.motion.guard import Guard
from tests.agent_fakes import ManualClock


def test_a_guard_that_died_and_cannot_be_started_refuses_motion_until_it_can(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    started: list[subprocess.Popen[bytes]] = []
    # A process that answers, without ROS.
    popen = subprocess.Popen

    def start(_command: Any, **settings: Any) -> subprocess.Popen[bytes]:
        if os.environ.get("NO_PROCESS"):
            raise OSError(11, "Resource temporarily unavailable")
        started.append(popen(["cat"], **settings))
        return started[-1]

    monkeypatch.setattr(subprocess, "Popen", start)
    clock = ManualClock()
    guard = Guard("guard", {}, clock)
    guard.start()
    assert select.select([started[0].stdout], [], [], 30)[0]
    assert guard.ready()
    monkeypatch.setenv("NO_PROCESS", "1")
    started[0].kill()
    started[0].wait()
    for _ in range(3):
        guard.tick()
        assert not guard.ready()
        assert not guard.tell("drive", 1.0)
        clock.advance(2)
    monkeypatch.delenv("NO_PROCESS")
    guard.tick()
    assert select.select([started[1].stdout], [], [], 30)[0]
    assert guard.ready()
    guard.close()
