"""The drive of the recorder's proof: what happens in and after each window."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path
from threading import Event

from iort_contract.messages.recorder import KEPT, Incident, Trigger
from testkit.proxy import FREEZE, PASS
from testkit.waiting import until
from tests.ros.recorder.account import Window, recovered, table, window
from tests.ros.recorder.robot import OFTEN, ONE, OTHER, TOPICS, Robot

BEFORE_S, AFTER_S = 2.0, 3.0
# A hundred triggers a minute.
EVERY_S, COOLDOWN_S, BUDGET_MB = 0.6, 4.0, 3.0
BACK_S = 120
KILL = "kill -9 in the window"


class Drive:
    """Of ``duration_s``, half is an outage and a tenth the burst of triggers."""

    def __init__(self, robot: Robot, duration_s: float) -> None:
        self.robot = robot
        self.outage_s, self.burst_s = max(5.0, duration_s / 2), max(12.0, duration_s / 10)
        self.windows: list[Window] = []
        self.burst: list[Incident] = []
        self.edges = self.cooled = 0
        # Messages that a foreign reader finds in a killed agent's ring, and those that the agent had written.
        self.recovered, self.written = 0, 0
        self.while_full: Incident | None = None
        self._files: list[tuple[str, Path, float]] = []
        self._known: set[str] = set()
        self._killed_us = 0
        self._pause = Event()

    def run(self) -> None:
        """Drive, and account for everything."""
        robot = self.robot
        robot.start_agent()
        robot.agent.until_said("connected to 127.0.0.1")
        robot.start_publisher()
        robot.trigger(_trigger("one", ONE), _trigger("other", OTHER))
        self._calm()
        self._overlapping()
        self._killed()
        self._restarted()
        self._without_broker()
        if robot.disk is not None:
            self._with_a_full_disk()
        self._with_a_clock_set_back()
        self._with_another_publisher()
        self._burst()
        robot.publisher.quit()
        assert robot.agent.terminate() in {0, 1}, "\n".join(robot.agent.errors[-25:])
        published = robot.published()
        self.windows = [
            replace(
                window(name, path, published, self._killed_us if name == KILL else None), bucket_s=seconds
            )
            for name, path, seconds in self._files
        ]

    def report(self) -> str:
        """The accounts as text."""
        lines = [table(self.windows), *(f"{one.name}: {one.why}" for one in self.windows if one.why)]
        lines.append(f"after kill -9: {self.recovered:,} messages in the ring, at least {self.written:,} due")
        if (full := self.while_full) is not None:
            lines.append(
                f"on a full disk: {full.state}: {full.why}; {full.messages:,}, missing {full.missing:,}"
            )
        states = ", ".join(one.state for one in self.burst)
        lines.append(
            f"{self.edges} triggers in {self.burst_s:g} s: {self.cooled} within the cooldown, {states}"
        )
        return "\n".join(lines)

    def _calm(self) -> None:
        self._collect("calm", self._fire())

    def _overlapping(self) -> None:
        at_s = self._fire()
        # This one comes in the window, and is in force from then on.
        self.robot.publisher.say("latch")
        self._fire(OTHER, rested=True)
        self._collect("two that overlap", at_s)

    def _killed(self) -> None:
        robot, at_s = self.robot, self._fire()
        self._pause.wait(1)
        self.written = robot.told()["recorder"]["ring"]["written"]
        self._killed_us = time.time_ns() // 1000
        robot.agent.kill()
        self.recovered = recovered(robot.ring)
        robot.start_agent()
        self._collect(KILL, at_s)

    def _restarted(self) -> None:
        robot, at_s = self.robot, self._fire()
        robot.proxy.mode = FREEZE
        until(lambda: robot.recorder("waiting"))
        assert robot.agent.terminate() in {0, 1}
        robot.proxy.mode = PASS
        robot.start_agent()
        self._collect("restart before the upload", at_s)

    def _without_broker(self) -> None:
        self.robot.proxy.mode = FREEZE
        at_s = self._fire()
        self._pause.wait(self.outage_s)
        self.robot.proxy.mode = PASS
        self._collect("no broker", at_s)

    def _with_a_full_disk(self) -> None:
        robot = self.robot
        with robot.full_disk():
            self._fire()
            self._pause.wait(2 * AFTER_S)

        def ended() -> list[Incident]:
            found = robot.incidents().values()
            return [one for one in found if one.id not in self._known and one.state != KEPT]

        (self.while_full,) = until(ended, within_s=120)
        self._known.add(self.while_full.id)
        self._collect("after a full disk", self._fire())

    def _with_a_clock_set_back(self) -> None:
        at_s = self._fire()
        self.robot.set_back(BACK_S)
        self._collect("clock set back", at_s)

    def _with_another_publisher(self) -> None:
        robot, at_s = self.robot, self._fire()
        if robot.graph.ros == 1:
            robot.graph.master.kill()
            robot.graph.start_master()
        robot.publisher.quit()
        robot.start_publisher()
        robot.set_back(BACK_S)
        self._collect("publisher and master restart", at_s)

    def _burst(self) -> None:
        robot, before = self.robot, self.robot.told()["recorder"]
        often = _trigger("often", OFTEN)
        robot.trigger(
            replace(often, before_s=0.2, after_s=0.3, cooldown_s=COOLDOWN_S, budget_mb_day=BUDGET_MB)
        )
        end_s = time.monotonic() + self.burst_s
        while time.monotonic() < end_s:
            robot.demand(OFTEN)
            self._pause.wait(EVERY_S)
        until(lambda: not robot.recorder("open") and not robot.recorder("waiting"))
        after = robot.told()["recorder"]
        self.edges, self.cooled = (after.get(name, 0) - before.get(name, 0) for name in ("edges", "cooled"))

        def told() -> list[Incident]:
            found = [one for one in robot.incidents().values() if one.trigger == often.name]
            ended = all(one.state != KEPT for one in found)
            return found if ended and len(found) >= self.edges - self.cooled else []

        self.burst = sorted(until(told, within_s=120), key=lambda one: one.from_us)

    def _fire(self, value: int = ONE, *, rested: bool = False) -> float:
        """Fire a trigger, once what happened before is out of its window; return when."""
        robot = self.robot
        if not rested:
            self._pause.wait(BEFORE_S + 1)
        before = robot.recorder("edges")
        robot.demand(value)
        at_s = time.monotonic()
        until(lambda: robot.recorder("edges") > before)
        return at_s

    def _collect(self, name: str, at_s: float) -> None:
        """Wait for the incident of an edge, and get its file."""
        (one,) = self.robot.uploaded(self._known)
        self._known.add(one.id)
        self._files.append((name, self.robot.download(one), time.monotonic() - at_s))


def _trigger(name: str, demand: int) -> Trigger:
    return Trigger(
        name,
        f"x == {demand}",
        stream="demand",
        before_s=BEFORE_S,
        after_s=AFTER_S,
        topics=TOPICS,
        cooldown_s=1.0,
    )
