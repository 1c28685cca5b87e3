"""The guard: motion is refused without it, nothing waits for it, and it stops the robot of a dead agent."""

from __future__ import annotations

import json
import os
import select
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any

import pytest

from iort_agent.control import guard as guard_process
from iort_agent.control.guard import Guard, StopFile
from iort_contract.ros1.definition import parse
from testkit.agent import ManualClock


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
        assert not guard.tell("/drive", 1.0, held=False)
        clock.advance(2)
    monkeypatch.delenv("NO_PROCESS")
    guard.tick()
    assert select.select([started[1].stdout], [], [], 30)[0]
    assert guard.ready()
    guard.close()


class Node:
    """A ROS node in a graph that is there."""

    failed = None

    def __init__(self) -> None:
        self.published: list[bytes] = []
        self.ready = threading.Event()
        self.ready.set()

    def definition(self, kind: str) -> Any:
        return parse(kind, "float64 data")

    def listeners(self, _topic: str) -> int:
        return 1

    def publish(self, _topic: str, data: bytes) -> bool:
        self.published.append(data)
        return True

    def lives(self, _base: str) -> bool:
        return False

    def advertise(self, *_: Any) -> None:
        pass

    start = close = advertise


def guarded(node: Node, monkeypatch: pytest.MonkeyPatch, *told: Any, queue: Path | None = None) -> None:
    """Run the guard's process in the node, for an agent that has told this and was killed."""
    lines, written = os.pipe()
    nobody, answers = os.pipe()
    os.close(nobody)
    stops = {"/speed": {"type": "std_msgs/Float64", "stop": {"data": 0.0}}}
    first = {"agent": "car", "stops": stops, "queue": str(queue) if queue is not None else None}
    for line in (first, *told):
        os.write(written, json.dumps(line).encode() + b"\n")
    os.close(written)
    monkeypatch.setattr(guard_process, "shared", lambda _name: node)
    monkeypatch.setattr(signal, "signal", lambda *_: None)
    with os.fdopen(lines) as stdin, os.fdopen(answers, "w") as stdout:
        monkeypatch.setattr(sys, "stdin", stdin)
        monkeypatch.setattr(sys, "stdout", stdout)
        assert guard_process.main() == 0
        monkeypatch.undo()


def test_the_lease_of_an_agent_that_was_killed_before_it_heard_the_answer_ends_with_stops(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    node = Node()
    guarded(node, monkeypatch, ["/speed", time.monotonic() + 100, False])
    assert len(node.published) == 5


def test_an_agent_that_is_back_for_a_moment_does_not_end_an_emergency_stop(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    node, looks = Node(), iter([True, True, False, True, True, True])
    monkeypatch.setattr(node, "lives", lambda _name: next(looks))
    monkeypatch.setattr(guard_process, "_LOOK_S", 0.01)
    queue = tmp_path / "queue.db"
    guarded(node, monkeypatch, ["/speed", None, True], queue=queue)
    assert next(looks, None) is None
    assert StopFile(queue).stopped, "the agent had no time to keep it"


def test_an_emergency_stop_goes_on_until_the_agent_is_back(monkeypatch: pytest.MonkeyPatch) -> None:
    node = Node()
    monkeypatch.setattr(node, "lives", lambda name: name == "car" and len(node.published) > 12)
    monkeypatch.setattr(guard_process, "_LOOK_S", 0.01)
    guarded(node, monkeypatch, ["/speed", None, True])
    assert len(node.published) > 12, "more than at the end of a lease"
    # The stop was released before the agent died.
    before = len(node.published)
    guarded(node, monkeypatch, ["/speed", None, True], ["/speed", None, False])
    assert len(node.published) == before
