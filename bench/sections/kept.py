"""The kept cloud, killed: five cars drive while processes of `make up` get SIGKILL, or its disk is full.

The emulator, its functions, all processes of `make up`, or an agent are killed at random moments; the code of
`iort audit` then counts what is lost.
"""

from __future__ import annotations

import os
import random
import signal
import ssl
import sys
import tempfile
import threading
import time
import urllib.error
import urllib.request
from collections import Counter, defaultdict
from collections.abc import Callable, Sequence
from contextlib import ExitStack, suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from types import TracebackType
from typing import Any

from typing_extensions import Self

from bench.report import KEPT, Section
from bench.sections import Declared, Option
from iort_contract.catalog.vesc import VESC_STREAM
from iort_station import kept
from iort_station.cloud import EMBEDDED, Cloud
from iort_station.data import inventory
from iort_station.errors import StationError
from iort_station.fleet import robots
from iort_station.operations import accounts, audit
from local.figures import Spread
from local.processes import Child
from testkit import ROOT, machine
from testkit.car import AgentProcess
from testkit.target import Say, Target
from testkit.waiting import InstrumentError


@dataclass(frozen=True)
class Counted:
    """The counts of a robot's streams together; ``lost`` are samples and batches that are not stored.

    ``killed_runs`` is how many runs of the agent did not end properly: what was in their open batches is no
    part of ``lost``, nor of ``incomplete``. ``summarized`` and ``expected`` are samples of the motor
    controller's stream alone.
    """

    samples: int
    batches: int
    duplicated: int
    lost: int
    incomplete: tuple[str, ...]
    killed_runs: int
    summarized: int
    expected: int


def count(cloud: Cloud, robot: str) -> Counted:
    """Audit every stream of a robot, from its first batch on."""
    told, now_us = accounts.accounts(cloud, robot), time.time_ns() // 1000
    audits = [
        accounts.held_against(
            audit.audit(name, audit.headers(cloud, robot, name), from_start=True), told, now_us
        )
        for name in inventory.known(cloud, robot)
    ]
    # A known stream of which the agent took nothing has no audit.
    audits = [one for one in audits if one.runs or one.refused or one.taken is not None]
    runs = [run for one in audits for run in one.runs]
    killed = {each.boot for one in audits for each in one.shortfalls if each.samples is None}
    known = [
        replace(one, shortfalls=tuple(each for each in one.shortfalls if each.samples is not None))
        for one in audits
    ]
    short = sum(abs(each.samples or 0) for one in known for each in one.shortfalls)
    return Counted(
        samples=sum(run.samples for run in runs),
        batches=sum(run.batches for run in runs),
        duplicated=sum(run.duplicated for run in runs),
        lost=sum(one.missing for one in audits) + short,
        incomplete=tuple(one.stream for one in known if not one.complete),
        killed_runs=len(killed),
        summarized=audit.samples_summarized(cloud, robot, VESC_STREAM),
        expected=sum(run.samples for one in audits if one.stream == VESC_STREAM for run in one.runs),
    )


_START_S, _AGAIN_S = 600.0, 120.0
_POLL_S = 0.05


class Up:
    """A kept cloud in a folder, from `__enter__` to `__exit__`."""

    def __init__(self, state: Path) -> None:
        self.state = state
        self.cloud: Cloud
        self._child: Child

    def __enter__(self) -> Self:
        self._start()
        file = self.state / EMBEDDED.name
        self._wait_for(file.exists, _START_S)
        # The file is there only while the cloud is up, and a kept cloud has the same address and keys again.
        self.cloud = Cloud.load(file)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._child.stop()

    @property
    def emulator(self) -> int | None:
        """The emulator's process; None while there is none."""
        for pid in machine.descendants(self._child.pid):
            with suppress(OSError):
                if b"local.emulator.run" in Path(f"/proc/{pid}/cmdline").read_bytes():
                    return pid
        return None

    def kill_emulator(self) -> float:
        """SIGKILL to the emulator and its functions; returns the seconds until it answers again."""
        if (pid := self.emulator) is not None:
            _kill([pid, *machine.descendants(pid)])
        return self._answering()

    def kill_all(self) -> float:
        """SIGKILL to every process of the cloud at once, and a new start; returns as `kill_emulator`."""
        _kill([self._child.pid, *machine.descendants(self._child.pid)])
        self._child.kill()
        self._start()
        return self._answering()

    def kill_function(self) -> float:
        """SIGKILL to the processes of the functions."""
        if (pid := self.emulator) is not None:
            _kill(machine.descendants(pid))
        return 0.0

    def wait_until_whole(self) -> None:
        """Wait until `make up` has done everything that belongs to a start."""

        def whole() -> bool:
            with suppress(StationError, OSError):
                return kept.Up.load(self.state).pids["up"] == self._child.pid
            return False

        self._wait_for(whole, _AGAIN_S)

    def _start(self) -> None:
        self._child = Child(
            "make up",
            # The machine may have a cloud of its user, too.
            [sys.executable, "-m", "local.up.run", "--state", str(self.state), "--ports", "any"],
            environment=dict(os.environ),
            cwd=ROOT,
            log=self.state.parent / "up.log",
        )

    def _answering(self) -> float:
        began, cloud = time.monotonic(), self.cloud
        context = ssl.create_default_context(cafile=cloud.ca_bundle)

        def answers() -> bool:
            with suppress(urllib.error.URLError, ConnectionError, TimeoutError):
                url = f"{cloud.endpoint_url}/_ministack/ready"
                with urllib.request.urlopen(url, timeout=5, context=context):  # noqa: S310 - always https
                    return True
            return False

        self._wait_for(answers, _AGAIN_S)
        return time.monotonic() - began

    def _wait_for(self, condition: Callable[[], bool], seconds: float) -> None:
        deadline = time.monotonic() + seconds
        while not condition():
            if self._child.poll() is not None and deadline - time.monotonic() < _AGAIN_S:
                # An emulator that ends too often ends it.
                self._start()
            if time.monotonic() > deadline:
                raise InstrumentError(f"the cloud is not up after {seconds:.0f} s:\n{self._child.tail()}")
            self._child.wait(_POLL_S)


def _kill(pids: list[int]) -> None:
    for pid in pids:
        with suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)


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

    def whole(self, name: str) -> bool:
        """Whether a car lost nothing but open batches of its killed agent, and all of it is summarised."""
        car = self.cars[name]
        return (
            not car.incomplete
            and car.summarized == car.expected
            and car.killed_runs <= self.agent_kills.get(name, 0)
            and all((one or 0) <= OPEN_MOST_S for one in self.open_s.get(name, ()))
        )


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


def run(_target: Target | None, say: Say, *, kills: int, seed: int) -> Section:
    """Kill so often, and count."""
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        killed = drive(Path(folder) / "kills", kills, seed or time.time_ns() % 2**32, say)
    return report(killed)


def report(killed: Kills) -> Section:
    """A row for each car, and whether anything is lost that may not be."""
    section = Section("kept", "Killed")
    times = ", ".join(f"{name} ({count})" for name, count in sorted(killed.killed.items()))
    section.table(
        f"Five cars at 50 Hz for {killed.seconds:.0f} s through: {times}",
        ["car", "batches", "samples", "lost", "open s", "sent twice", "summarised"],
        (
            [
                name,
                f"{car.batches:,}",
                f"{car.samples:,}",
                f"**{car.lost:,}**" if car.lost else "0",
                ", ".join("all" if one is None else f"{one:.2f}" for one in killed.open_s.get(name, ()))
                or "-",
                f"{car.duplicated:,}",
                f"{car.summarized:,} of {car.expected:,}",
            ]
            for name, car in killed.cars.items()
        ),
    )
    bad = sum(not killed.whole(name) for name in killed.cars)
    section.ratio("cars that lost more than an open batch", bad, 0, unit="cars")
    if killed.restart_s and killed.restart_s.p50 is not None:
        section.notes.append(f"The emulator answered again after {killed.restart_s.p50:.1f} s (median).")
    if killed.open_s:
        section.notes.append(
            "`open s`: how long before each kill of an agent its last stored sample was taken. What came "
            "after that was in the batch of a second that was still open. `all`: it had sent none."
        )
    section.raw = asdict(killed)
    return section


SECTION = Declared(
    "the cloud of `make up`, killed at random moments of a drive",
    run,
    (
        Option("KILLS", int, 50, "kills"),
        Option("SEED", int, 0, "of the random moments; 0: another each time"),
    ),
    KEPT,
    cloud=False,
    prepare=lambda: machine.enter("bench.run"),
)
