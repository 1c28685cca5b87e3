"""The kept cloud, killed: five cars drive while processes of `make up` get SIGKILL.

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
import urllib.request
from collections import Counter, defaultdict
from collections.abc import Callable, Sequence
from contextlib import ExitStack, suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import NamedTuple

from typing_extensions import Self

from bench.report import Report, Section
from bench.sections import Declared, Option
from iort_contract.catalog.vesc import VESC_STREAM
from iort_station.cloud import EMBEDDED, Cloud
from iort_station.data import inventory
from iort_station.data.accounts import accounts
from iort_station.fleet import robots
from iort_station.operations import audit
from local.figures import Spread
from local.processes import Child
from testkit import ROOT, machine
from testkit.car import AgentProcess
from testkit.target import Say, Target
from testkit.waiting import InstrumentError, reached, until

CARS, RATE_HZ = 5, 50
# What a killed agent may take with it: the open batch of a second, and the time until that is on its disk.
OPEN_MOST_S = 2.5
# Between the moment at which the emulator answers again and the next kill.
_PAUSES_S = 0.3, 6.0
_START_S, _AGAIN_S, _POLL_S, _FIRST_S, _SUMMARY_S = 600.0, 120.0, 0.05, 60.0, 120.0


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

    def __exit__(self, *_: object) -> None:
        self._child.stop()

    def kill_emulator(self) -> float:
        """SIGKILL to the emulator and its functions; returns the seconds until it answers again."""
        _kill(*(pid for emulator in self._emulators() for pid in (emulator, *machine.descendants(emulator))))
        return self._answering()

    def kill_all(self) -> float:
        """SIGKILL to every process of the cloud at once, and a new start; returns as `kill_emulator`."""
        _kill(self._child.pid, *machine.descendants(self._child.pid))
        self._child.kill()
        self._start()
        return self._answering()

    def kill_functions(self) -> float:
        """SIGKILL to the processes of the functions."""
        _kill(*(pid for emulator in self._emulators() for pid in machine.descendants(emulator)))
        return 0.0

    def _emulators(self) -> list[int]:
        """The emulator's process, if there is one."""

        def command(pid: int) -> bytes:
            with suppress(OSError):
                return Path(f"/proc/{pid}/cmdline").read_bytes()
            return b""

        below = machine.descendants(self._child.pid)
        return [pid for pid in below if b"local.emulator.run" in command(pid)][:1]

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
        began, context = time.monotonic(), ssl.create_default_context(cafile=self.cloud.ca_bundle)
        url = f"{self.cloud.endpoint_url}/_ministack/ready"

        def answers() -> bool:
            with (
                suppress(OSError),
                urllib.request.urlopen(url, timeout=5, context=context),  # noqa: S310 - always https
            ):
                return True
            return False

        self._wait_for(answers, _AGAIN_S)
        return time.monotonic() - began

    def _wait_for(self, condition: Callable[[], bool], seconds: float) -> None:
        deadline = time.monotonic() + seconds

        def holds() -> bool:
            if self._child.poll() is not None and deadline - time.monotonic() < _AGAIN_S:
                # An emulator that ends too often ends it.
                self._start()
            return condition()

        try:
            until(holds, within_s=seconds, poll_s=_POLL_S)
        except InstrumentError as error:
            raise InstrumentError(f"the cloud is not up: {error}:\n{self._child.tail()}") from None


def _kill(*pids: int) -> None:
    for pid in pids:
        with suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)


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
    account, now_us = accounts(cloud, robot), time.time_ns() // 1000
    audits = [
        audit.held_against(
            audit.audit(name, audit.headers(cloud, robot, name), from_start=True), account, now_us
        )
        for name in inventory.known(cloud, robot)
    ]
    # A known stream of which the agent took nothing has no audit.
    audits = [each for each in audits if each.runs or each.refused or each.taken is not None]
    runs = [run for each in audits for run in each.runs]
    shortfalls = [short for each in audits for short in each.shortfalls]
    known = [
        replace(each, shortfalls=tuple(short for short in each.shortfalls if short.samples is not None))
        for each in audits
    ]
    return Counted(
        samples=sum(run.samples for run in runs),
        batches=sum(run.batches for run in runs),
        duplicated=sum(run.duplicated for run in runs),
        lost=sum(each.missing for each in audits) + sum(abs(short.samples or 0) for short in shortfalls),
        incomplete=tuple(each.stream for each in known if not each.complete),
        killed_runs=len({short.boot for short in shortfalls if short.samples is None}),
        summarized=audit.samples_summarized(cloud, robot, VESC_STREAM),
        expected=sum(run.samples for each in audits if each.stream == VESC_STREAM for run in each.runs),
    )


class AgentKill(NamedTuple):
    """When the agent of a robot was started and killed, in microseconds since the epoch."""

    robot: str
    started_us: int
    killed_us: int


@dataclass(frozen=True)
class Kills:
    """What was killed how often, and what the audit counted of each car afterwards.

    ``open_s`` has, by car, how long before each kill of its agent the last stored sample was taken; None for
    a run that was killed before its first batch.
    """

    killed: dict[str, int]
    seed: int
    seconds: float
    restart_s: Spread
    cars: dict[str, Counted]
    open_s: dict[str, list[float | None]]

    def whole(self, name: str) -> bool:
        """Whether a car lost nothing but open batches of its killed agent, and all of it is summarised."""
        car, open_s = self.cars[name], self.open_s.get(name, [])
        return (
            not car.incomplete
            and car.summarized == car.expected
            and car.killed_runs <= len(open_s)
            and all((seconds or 0) <= OPEN_MOST_S for seconds in open_s)
        )


def drive(folder: Path, kills: int, seed: int, say: Say) -> Kills:
    """Kill so often, and count."""
    chance = random.Random(seed)  # noqa: S311 - moments, no secrets
    killed, restarts, agent_kills = Counter[str](), list[float](), list[AgentKill]()
    say("starting the cloud")
    with ExitStack() as stack, ExitStack() as driving:
        up = stack.enter_context(Up(folder / "state"))
        settings = {
            "sources": [{"type": "sim", "rate_hz": RATE_HZ, "pose": {"rate_hz": 0}}],
            "queue": {"path": "queue.db"},
        }
        cloud, names = up.cloud, [f"car{i + 1}" for i in range(CARS)]
        cars = [robots.add(cloud, name, out=folder / "cars", settings=settings) for name in names]
        agents = [driving.enter_context(AgentProcess(car, drain_s=_SUMMARY_S)) for car in cars]

        def kill_agent() -> float:
            agent = chance.choice(agents)
            agent_kills.append(AgentKill(agent.robot, agent.started_us, agent.kill()))
            return 0.0

        ways: dict[str, Callable[[], float]] = {
            "killed emulator": up.kill_emulator,
            "all killed": up.kill_all,
            "killed functions": up.kill_functions,
            "killed agent": kill_agent,
        }
        _wait_until_driving(cloud, names)
        began = time.monotonic()
        # Each way comes, whatever the dice say.
        order = [*ways, *chance.choices(sorted(ways), k=max(0, kills - len(ways)))][:kills]
        chance.shuffle(order)
        for number, what in enumerate(order):
            threading.Event().wait(chance.uniform(*_PAUSES_S))
            say(f"{number + 1} of {kills}: {what}")
            restarts.append(ways[what]())
            killed[what] += 1
        seconds = time.monotonic() - began
        # An agent that is told to end while it starts leaves its queue for the next start.
        _wait_until_driving(cloud, names, time.time_ns() // 1000)
        say("the cars stop, and send what they have")
        driving.close()
        say("counting")
        counted = {name: _count(cloud, name) for name in names}
        open_s = _open_s(cloud, agent_kills)
    restart_s = Spread.of([took_s for took_s in restarts if took_s])
    return Kills(dict(killed), seed, seconds, restart_s, counted, open_s)


def _wait_until_driving(cloud: Cloud, names: Sequence[str], since_us: int | None = None) -> None:
    """Wait for a batch of each car that begins after a time."""
    for name in names:
        until(
            lambda name=name: next(audit.headers(cloud, name, VESC_STREAM, since_us), None),  # type: ignore[misc]  # bound now
            f"a batch of {name}",
            _FIRST_S,
        )


def _open_s(cloud: Cloud, agent_kills: Sequence[AgentKill]) -> dict[str, list[float | None]]:
    """How long before each kill of an agent the last stored sample of that run was taken: see `Kills`."""
    times_us = {
        robot: [us for batch in audit.batches(cloud, robot, VESC_STREAM) for us in batch.times_us]
        for robot in {kill.robot for kill in agent_kills}
    }
    open_s: dict[str, list[float | None]] = defaultdict(list)
    for robot, started_us, killed_us in agent_kills:
        of_run = [us for us in times_us[robot] if started_us <= us <= killed_us]
        open_s[robot].append(round((killed_us - max(of_run)) / 1e6, 3) if of_run else None)
    return dict(open_s)


def _count(cloud: Cloud, robot: str) -> Counted:
    """Count when the summaries are complete, or come no more."""
    counted = count(cloud, robot)

    def whole() -> bool:
        nonlocal counted
        counted = count(cloud, robot)
        return counted.summarized >= counted.expected

    reached(whole, within_s=_SUMMARY_S)
    return counted


def run(_target: Target | None, say: Say, *, kills: int, seed: int) -> Section:
    """Kill so often, and count."""
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        return report(drive(Path(folder), kills, seed or time.time_ns() % 2**32, say))


def report(killed: Kills) -> Section:
    """A row for each car, and whether anything is lost that may not be."""
    section, rows = Section("kept", "Killed"), []
    for name, car in killed.cars.items():
        open_s = ", ".join("all" if s is None else f"{s:.2f}" for s in killed.open_s.get(name, ())) or "-"
        lost = f"**{car.lost:,}**" if car.lost else "0"
        summarized = f"{car.summarized:,} of {car.expected:,}"
        rows.append(
            [name, f"{car.batches:,}", f"{car.samples:,}", lost, open_s, f"{car.duplicated:,}", summarized]
        )
    times = ", ".join(f"{name} ({count})" for name, count in sorted(killed.killed.items()))
    section.table(
        f"Five cars at 50 Hz for {killed.seconds:.0f} s through: {times}",
        ["car", "batches", "samples", "lost", "open s", "sent twice", "summarised"],
        rows,
    )
    bad = sum(not killed.whole(name) for name in killed.cars)
    section.ratio("cars that lost more than an open batch", bad, 0, unit="cars")
    section.notes.append(
        f"The emulator answered again after {killed.restart_s.p50} s (median). `open s`: how long before "
        "each kill of an agent its last stored sample was taken. What came after that was in the batch of a "
        "second that was still open. `all`: it had sent none."
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
    Report("kept", "The kept cloud, killed", "make bench ONLY=kept"),
    cloud=False,
)
