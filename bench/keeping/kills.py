"""A drive of five cars on a kept cloud whose processes are killed at random moments."""

from __future__ import annotations

import random
import threading
import time
from collections import Counter
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from bench.keeping.counted import Counted, count
from bench.keeping.up import Up
from bench.load.agent_process import AgentProcess
from bench.report.result import Table
from iort_station.fleet import robots
from local.figures import Spread

CARS, RATE_HZ = 5, 50
# Between the moment at which the emulator answers again and the next kill.
_LEAST_S, _MOST_S = 0.3, 6.0
_SUMMARY_S = 120.0


@dataclass(frozen=True)
class Kills:
    """What was killed how often, and what the audit found of each car afterwards."""

    killed: dict[str, int]
    seed: int
    seconds: float
    restart_s: Spread | None
    cars: dict[str, Counted]

    @property
    def good(self) -> bool:
        """Whether nothing is lost and everything is summarised."""
        cars = self.cars.values()
        return all(not one.incomplete and one.summarized == one.expected for one in cars)

    def as_json(self) -> dict[str, Any]:
        """All figures."""
        return asdict(self)

    def table(self) -> Table:
        """A row for each car."""
        head = ("car", "batches", "samples", "lost", "sent twice", "summarised")
        rows = [
            (
                name,
                f"{one.batches:,}",
                f"{one.samples:,}",
                f"**{one.lost:,}**" if one.lost else "0",
                f"{one.duplicated:,}",
                f"{one.summarized:,} of {one.expected:,}",
            )
            for name, one in self.cars.items()
        ]
        told = ", ".join(f"{name} {times} times" for name, times in sorted(self.killed.items()))
        return Table(f"Five cars at 50 Hz for {self.seconds:.0f} s, killed: {told}", head, rows)


def drive(folder: Path, kills: int, seed: int, say: Callable[[str], None]) -> Kills:
    """Kill so often, and count."""
    chance = random.Random(seed)  # noqa: S311 - moments, no secrets
    killed, restarts = Counter[str](), []
    say("starting the cloud")
    folder.mkdir(parents=True)
    with Up(folder / "state") as up, ExitStack() as driving:
        settings: dict[str, Any] = {
            "sources": [{"type": "sim", "rate_hz": RATE_HZ, "pose": {"rate_hz": 0}}],
            "queue": {"path": "queue.db"},
        }
        cloud = up.cloud
        cars = [robots.add(cloud, f"car{i + 1}", out=folder / "cars", settings=settings) for i in range(CARS)]
        ways = {
            "the emulator": up.kill_emulator,
            "all processes": up.kill_all,
            "the functions": up.kill_function,
        }
        for car in cars:
            driving.enter_context(AgentProcess(car, drain_s=_SUMMARY_S))
        began = time.monotonic()
        for number in range(kills):
            threading.Event().wait(chance.uniform(_LEAST_S, _MOST_S))
            what = chance.choice(sorted(ways))
            say(f"kill {number + 1} of {kills}: {what}")
            restarts.append(ways[what]())
            killed[what] += 1
        seconds = time.monotonic() - began
        say("the cars stop, and send what they have")
        driving.close()
        say("counting")
        found = {car.robot: _summarized(up, car.robot) for car in cars}
    return Kills(dict(killed), seed, seconds, Spread.of([one for one in restarts if one]), found)


def _summarized(up: Up, robot: str) -> Counted:
    """Count when the summaries are complete, or come no more."""
    cloud, deadline = up.cloud, time.monotonic() + _SUMMARY_S
    while True:
        found = count(cloud, robot)
        if found.summarized >= found.expected or time.monotonic() > deadline:
            return found
        threading.Event().wait(1)
