"""The guard: motion is refused without it, nothing waits for it, and it stops the robot of a dead agent."""

from __future__ import annotations

import errno
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
from unittest.mock import Mock

import pytest

from iort_agent.control import guard as guard_module
from iort_agent.control.guard import Guard, StopFile
from iort_agent.control.leases import STOP_AHEAD_MS
from iort_contract.messages.commands import NO_GUARD
from iort_contract.ros.definition import parse
from testkit.agent import ManualClock
from testkit.waiting import GUARD_S
from tests.unit.agent.control.downlink_rig import LEASE_MS, T0, FakeGuard, Rig, doubles

pytestmark = pytest.mark.usefixtures("ros")


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
    assert select.select([started[0].stdout], [], [], GUARD_S)[0]
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
    assert select.select([started[1].stdout], [], [], GUARD_S)[0]
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

    def living(self, _base: str) -> frozenset[str]:
        return frozenset()

    def advertise(self, *_: Any) -> None:
        pass

    start = close = advertise


def guarded(node: Node, monkeypatch: pytest.MonkeyPatch, *told: Any, queue: Path | None = None) -> None:
    """Run the guard's process in the node, for an agent that has told this and was killed."""
    lines, written = os.pipe()
    nobody, answers = os.pipe()
    os.close(nobody)
    stops = {"/speed": {"type": "std_msgs/Float64", "stop": {"data": 0.0}}}
    first = {"agent": "car", "ros": 1, "stops": stops, "queue": str(queue) if queue is not None else None}
    for line in (first, *told):
        os.write(written, json.dumps(line).encode() + b"\n")
    os.close(written)
    monkeypatch.setitem(guard_module.NODES, 1, lambda _name: node)
    monkeypatch.setattr(signal, "signal", lambda *_: None)
    with os.fdopen(lines) as stdin, os.fdopen(answers, "w") as stdout:
        monkeypatch.setattr(sys, "stdin", stdin)
        monkeypatch.setattr(sys, "stdout", stdout)
        assert guard_module.main() == 0
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
    # The one that died seems to live for a while, as in ROS 2.
    old, new = frozenset(["old"]), frozenset(["new"])
    node, looks = Node(), iter([old, old, old, old, old | new, old | new, old, new, new, new])
    monkeypatch.setattr(node, "living", lambda _name: next(looks))
    monkeypatch.setattr(guard_module, "_LOOK_S", 0.01)
    queue = tmp_path / "queue.db"
    guarded(node, monkeypatch, ["/speed", None, True], queue=queue)
    assert next(looks, None) is None
    assert StopFile(queue).stopped, "the agent had no time to keep it"


def test_an_emergency_stop_goes_on_until_the_agent_is_back(monkeypatch: pytest.MonkeyPatch) -> None:
    node = Node()
    back = frozenset(["back"])
    monkeypatch.setattr(
        node, "living", lambda name: back if name == "car" and len(node.published) > 12 else frozenset()
    )
    monkeypatch.setattr(guard_module, "_LOOK_S", 0.01)
    guarded(node, monkeypatch, ["/speed", None, True])
    assert len(node.published) > 12, "more than at the end of a lease"
    # The stop was released before the agent died.
    before = len(node.published)
    guarded(node, monkeypatch, ["/speed", None, True], ["/speed", None, False])
    assert len(node.published) == before


def test_without_the_guard_no_motion_passes_and_an_alarm_says_why() -> None:
    clock = ManualClock(now_us=T0)
    guard = FakeGuard(clock)
    rig, guard.up = Rig(clock=clock, guard=guard), False
    rig.send({"data": 1.0})
    rig.send({"data": "hello"}, name="say", lease_ms=None)
    assert [topic for topic, _ in rig.graph.published] == ["/say"]
    assert rig.refused() == {f"cmd/iort/car1/speed {NO_GUARD}": 1}
    assert rig.downlink.alarms() == ["the guard does not run yet: no motion until it does"]
    assert rig.downlink.report()["guard"] is False
    guard.up = True
    rig.send({"data": 1.0})
    assert len(rig.graph.published) == 2
    assert rig.downlink.alarms() == []


class DyingError(Exception):
    """The agent's end."""


class DyingGuard(FakeGuard):
    """The agent dies while it tells."""

    def tell(self, _topic: str, _until: float | None, *, held: bool) -> bool:
        raise DyingError


def test_the_guard_stops_at_the_leases_end_and_the_agent_before_it() -> None:
    clock = ManualClock(now_us=T0)
    guard = FakeGuard(clock)
    rig = Rig(clock=clock, guard=guard)
    ahead_s = STOP_AHEAD_MS / 1000
    rig.send({"data": 2.5})
    rig.send({"data": 2.5}, lease_ms=STOP_AHEAD_MS + 1)
    clock.advance(0.001)
    # Not before the stop is written, which takes another thread's time.
    assert rig.downlink.tick() == pytest.approx(0.02)
    assert rig.graph.published[-1] == ("/commands/motor/speed", doubles(0.0))
    assert len(guard.told) == 2
    clock.advance(0.02)
    rig.downlink.tick()
    # A driver lets go: the guard's stop must not overtake the motion before it.
    rig.send({"data": 1.0})
    rig.send({"data": 0.0}, ends=True)
    rig.downlink.tick()
    rig.downlink.set_stopped(True)
    at = clock.monotonic()
    began = at - 0.021
    assert guard.told == [
        (began, pytest.approx(began + LEASE_MS / 1000), False),
        (began, pytest.approx(began + 0.001 + ahead_s), False),
        (at, None, False),
        (at, pytest.approx(at + LEASE_MS / 1000), False),
        (at, pytest.approx(at + ahead_s), False),
        (at, None, True),
    ]


def test_the_guard_knows_of_an_emergency_stop_before_the_first_stop() -> None:
    rig = Rig(guard=DyingGuard(ManualClock(now_us=T0)))
    with pytest.raises(DyingError):
        rig.downlink.set_stopped(True)
    assert rig.graph.published == []


def test_the_guard_stops_what_an_agent_outside_the_graph_cannot() -> None:
    clock = ManualClock(now_us=T0)
    guard = FakeGuard(clock)
    rig = Rig(clock=clock, guard=guard)
    rig.send({"data": 2.5})
    # Another node has taken the agent's name.
    rig.graph.up = False
    clock.advance(0.3)
    rig.downlink.tick()
    assert guard.told == [(1000.0, pytest.approx(1000 + LEASE_MS / 1000), False)], (
        "the lease ends for it, too"
    )
    rig.downlink.set_stopped(True)
    assert guard.told[1:] == [(1000.3, None, True)]
    assert not guard.stops
    rig.graph.up = True
    clock.advance(0.1)
    rig.downlink.tick()
    assert guard.stops
    rig.graph.up = False
    rig.downlink.set_stopped(False)
    assert guard.told[-1][1:] == (None, False), "it must not hold what was released"


def test_an_agent_that_ends_by_itself_leaves_an_emergency_stop_to_the_guard() -> None:
    guard = FakeGuard(ManualClock(now_us=T0))
    rig = Rig(guard=guard)
    rig.downlink.set_stopped(True)
    rig.downlink.halt(keep_stop=True)
    rig.downlink.close(keep_stop=True)
    assert guard.left
    assert [held for _, _, held in guard.told] == [True]


def test_an_emergency_stop_is_kept_once_the_disk_works_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    queue = tmp_path / "queue.db"
    kept = StopFile(queue)
    with monkeypatch.context() as full:
        full.setattr(Path, "touch", Mock(side_effect=OSError(errno.ENOSPC, "No space left on device")))
        kept.write(stopped=True)
        kept.tick()
        assert "No space left" in (kept.alarm or "")
        assert not StopFile(queue).stopped
    kept.tick()
    assert kept.alarm is None
    assert StopFile(queue).stopped
    kept.write(stopped=False)
    assert not StopFile(queue).stopped
