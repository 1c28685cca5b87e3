"""A drive of five cars on a kept cloud: at random moments processes are killed, or its disk is full."""

from __future__ import annotations

import random
import threading
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from bench.keeping.counted import Counted, count, counted
from bench.keeping.up import Up
from iort_contract.catalog.vesc import VESC_STREAM
from iort_station.cloud import Cloud
from iort_station.fleet import robots
from iort_station.operations import audit
from local.figures import Spread
from testkit import machine
from testkit.car import AgentProcess
from testkit.command import Table
from testkit.waiting import InstrumentError

CARS, RATE_HZ = 5, 50
# What a killed agent may take with it: the open batch of a second, and the time until that is on its disk.
OPEN_MOST_S = 2.5
# Between the moment at which the emulator answers again and the next kill; and how long the disk is full.
_LEAST_S, _MOST_S = 0.3, 6.0
_FULL_LEAST_S, _FULL_MOST_S = 3.0, 10.0
_FIRST_S, _SUMMARY_S = 60.0, 120.0


@dataclass(frozen=True)
class AgentKill:
    """When the agent of a robot was started and killed, in microseconds since the epoch."""

    robot: str
    started_us: int
    killed_us: int


@dataclass(frozen=True)
class Kills:
    """What was killed how often, and what the audit found of each car afterwards.

    ``open_s`` has, by car, how long before each kill of its agent the last stored sample was taken; None for
    a run that was killed before its first batch.
    """

    killed: dict[str, int]
    seed: int
    seconds: float
    restart_s: Spread | None
    cars: dict[str, Counted]
    agent_kills: dict[str, int]
    open_s: dict[str, list[float | None]]

    @property
    def good(self) -> bool:
        """Whether nothing is lost but open batches of killed agents, and everything is summarised."""
        there = all(
            not one.incomplete
            and one.summarized == one.expected
            and one.killed_runs <= self.agent_kills.get(name, 0)
            for name, one in self.cars.items()
        )
        return there and all((one or 0) <= OPEN_MOST_S for each in self.open_s.values() for one in each)

    def as_json(self) -> dict[str, Any]:
        return asdict(self)

    @classmethod
    def of_json(cls, figures: dict[str, Any]) -> Kills:
        """The figures that `as_json` returned."""
        restart_s = figures["restart_s"] and Spread(**figures["restart_s"])
        return cls(**{**figures, "restart_s": restart_s, "cars": counted(figures["cars"])})

    def table(self) -> Table:
        """A row for each car."""
        head = ("car", "batches", "samples", "lost", "open s", "sent twice", "summarised")
        rows = [
            (
                name,
                f"{one.batches:,}",
                f"{one.samples:,}",
                f"**{one.lost:,}**" if one.lost else "0",
                ", ".join("all" if one is None else f"{one:.2f}" for one in self.open_s.get(name, ())) or "-",
                f"{one.duplicated:,}",
                f"{one.summarized:,} of {one.expected:,}",
            )
            for name, one in self.cars.items()
        ]
        told = ", ".join(f"{name} ({times})" for name, times in sorted(self.killed.items()))
        return Table(f"Five cars at 50 Hz for {self.seconds:.0f} s through: {told}", head, rows)


def drive(folder: Path, kills: int, seed: int, say: Callable[[str], None]) -> Kills:
    """Kill so often, and count."""
    chance = random.Random(seed)  # noqa: S311 - moments, no secrets
    killed, restarts, agent_kills = Counter[str](), list[float](), list[AgentKill]()
    say("starting the cloud")
    folder.mkdir(parents=True)
    with ExitStack() as stack, ExitStack() as driving:
        small = stack.enter_context(machine.Disk(folder / "state")) if machine.possible() else None
        up = stack.enter_context(Up(folder / "state"))
        settings: dict[str, Any] = {
            "sources": [{"type": "sim", "rate_hz": RATE_HZ, "pose": {"rate_hz": 0}}],
            "queue": {"path": "queue.db"},
        }
        cloud = up.cloud
        cars = [robots.add(cloud, f"car{i + 1}", out=folder / "cars", settings=settings) for i in range(CARS)]
        agents = [driving.enter_context(AgentProcess(car, drain_s=_SUMMARY_S)) for car in cars]

        def kill_agent() -> float:
            agent = chance.choice(agents)
            agent_kills.append(AgentKill(agent.robot, agent.started_us, agent.kill()))
            return 0.0

        ways: dict[str, Callable[[], float]] = {
            "killed emulator": up.kill_emulator,
            "all killed": up.kill_all,
            "killed functions": up.kill_function,
            "killed agent": kill_agent,
        }
        if small:
            ways["full disk"] = lambda: _full(small, up, chance.uniform(_FULL_LEAST_S, _FULL_MOST_S))
        else:
            say("the disk is never full: this machine allows nobody a mount namespace of his own")
        _wait_until_driving(cloud)
        began = time.monotonic()
        # Each way comes, whatever the dice say.
        order = [*ways, *chance.choices(sorted(ways), k=max(0, kills - len(ways)))][:kills]
        chance.shuffle(order)
        for number, what in enumerate(order):
            threading.Event().wait(chance.uniform(_LEAST_S, _MOST_S))
            say(f"{number + 1} of {kills}: {what}")
            restarts.append(ways[what]())
            killed[what] += 1
        seconds = time.monotonic() - began
        # An agent that is told to end while it starts leaves its queue for the next start.
        _wait_until_driving(cloud, time.time_ns() // 1000)
        say("the cars stop, and send what they have")
        driving.close()
        say("counting")
        found = {car.robot: _summarized(up, car.robot) for car in cars}
        open_s = _open_s(cloud, agent_kills)
    return Kills(
        killed=dict(killed),
        seed=seed,
        seconds=seconds,
        restart_s=Spread.of([one for one in restarts if one]),
        cars=found,
        agent_kills=dict(Counter(one.robot for one in agent_kills)),
        open_s=open_s,
    )


def _full(small: machine.Disk, up: Up, seconds: float) -> float:
    """Let the disk be full. Raises `InstrumentError` if a batch is stored all the same."""
    # It starts with free space only.
    up.wait_until_whole()
    with small.full():
        # A batch that was written before may still have to be acknowledged.
        threading.Event().wait(1.0)
        before = _stored(up.cloud)
        threading.Event().wait(seconds)
        after = _stored(up.cloud)
    if after != before:
        raise InstrumentError(f"{after - before} batches were stored on a full disk")
    return 0.0


def _wait_until_driving(cloud: Cloud, since_us: int | None = None) -> None:
    """Wait for a batch of each car that begins after a time."""
    deadline = time.monotonic() + _FIRST_S
    for i in range(CARS):
        while next(audit.headers(cloud, f"car{i + 1}", VESC_STREAM, since_us), None) is None:
            if time.monotonic() > deadline:
                raise InstrumentError(f"car{i + 1} has sent no batch in {_FIRST_S:.0f} s")
            threading.Event().wait(0.2)


def _stored(cloud: Cloud) -> int:
    return sum(1 for i in range(CARS) for _ in audit.headers(cloud, f"car{i + 1}", VESC_STREAM))


def _open_s(cloud: Cloud, agent_kills: Sequence[AgentKill]) -> dict[str, list[float | None]]:
    """How long before each kill of an agent the last stored sample of that run was taken: see `Kills`."""
    found: dict[str, list[float | None]] = defaultdict(list)
    for robot in dict.fromkeys(one.robot for one in agent_kills):
        batches = audit.batches(cloud, robot, VESC_STREAM)
        times_us = [time_us for batch in batches for time_us in batch.times_us]
        for one in agent_kills:
            of_run = [time_us for time_us in times_us if one.started_us <= time_us <= one.killed_us]
            if one.robot == robot:
                found[robot].append(round((one.killed_us - max(of_run)) / 1e6, 3) if of_run else None)
    return dict(found)


def _summarized(up: Up, robot: str) -> Counted:
    """Count when the summaries are complete, or come no more."""
    cloud, deadline = up.cloud, time.monotonic() + _SUMMARY_S
    while True:
        found = count(cloud, robot)
        if found.summarized >= found.expected or time.monotonic() > deadline:
            return found
        threading.Event().wait(1)
