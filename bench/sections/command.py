"""The command `iort`: how long a person waits for help, for an answer and for TAB.

Each is a process of its own, in turns with Python doing nothing: the ratio of their processor times
depends little on the machine.
"""

from __future__ import annotations

import os
import resource
import subprocess
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from statistics import median
from typing import NamedTuple

from bench.load import stored_drive
from bench.report import Section, ratio
from bench.sections import Declared
from iort_contract.catalog.vesc import VESC_STREAM
from iort_station.cloud import EMBEDDED
from testkit.car import RATE_HZ
from testkit.target import Say, Target

REPEATS = 5
_PYTHON = "python -c pass"
# The most that a command may take, as a multiple of Python doing nothing, and what the person may wait.
TARGETS = {
    "iort --help": (10.0, "0.25 s"),
    "iort query, a minute": (32.0, "0.8 s"),
    "TAB: a verb": (12.0, "0.3 s"),
    "TAB: a robot": (12.0, "0.3 s"),
}


class Times(NamedTuple):
    """The seconds of one process: those that a person waits, and those of the processor."""

    wall_s: float
    cpu_s: float


def run(target: Target, say: Say) -> Section:
    """Run each command in turns."""
    robot = target.robot("bench-command").robot
    say("storing a minute of one robot")
    stored_drive.store(target, robot, stored_drive.simulated(60 * RATE_HZ))
    iort = [str(Path(sys.executable).parent / "iort"), *options_of(target)]
    tab = {"_IORT_COMPLETE": "complete_bash", "XDG_CACHE_HOME": str(target.folder / "cache")}
    ways: dict[str, tuple[list[str], Mapping[str, str]]] = {
        _PYTHON: ([sys.executable, "-c", "pass"], {}),
        "iort --help": ([*iort, "--help"], {}),
        "iort query, a minute": ([*iort, "query", robot, VESC_STREAM, "--last", "3m"], {}),
        "TAB: a verb": (iort[:1], tab | _line([*iort, "qu"])),
        "TAB: a robot": (iort[:1], tab | _line([*iort, "query", robot[:-1]])),
    }
    measured: dict[str, list[Times]] = {name: [] for name in ways}
    for turn in range(REPEATS + 1):
        say(f"{turn} of {REPEATS}" if turn else "to warm up")
        for name, (command, environment) in ways.items():
            times = _timed(command, environment)
            measured[name] += [times] if turn else []
    return report(measured)


def report(measured: Mapping[str, list[Times]]) -> Section:
    """Make the section of the times of every command."""
    section, rows = Section("command", "The command iort"), []
    for name, times in measured.items():
        _, wait = TARGETS.get(name, (0, ""))
        rows.append([name, *(f"{median(column):.3f} s" for column in zip(*times, strict=True)), wait])
    section.table(f"Median of {REPEATS}", ["command", "wall", "processor", "wanted"], rows)
    cpu_s = {name: [[time.cpu_s] for time in times] for name, times in measured.items()}
    for name, (most, _) in TARGETS.items():
        section.ratio(f"{name}: processor / {_PYTHON}", ratio(cpu_s[name], cpu_s[_PYTHON]), most)
    section.notes.append(
        "The names of robots come from a file that an earlier TAB has had written; only the first TAB waits "
        "for the cloud."
    )
    section.raw = {name: [times._asdict() for times in each] for name, each in measured.items()}
    return section


def options_of(target: Target) -> list[str]:
    """The options of `iort` that select a target's cloud."""
    if target.embedded is not None:
        return ["--local", "--embedded", str(target.embedded.folder / EMBEDDED.name)]
    cloud = target.cloud
    chosen = {"--namespace": cloud.namespace, "--region": cloud.region, "--profile": cloud.profile}
    return [part for name, value in chosen.items() if value for part in (name, value)]


def _line(words: list[str]) -> dict[str, str]:
    """What bash says of the line: its words, and that the last one is incomplete."""
    return {"COMP_WORDS": " ".join(words), "COMP_CWORD": str(len(words) - 1)}


def _timed(command: list[str], environment: Mapping[str, str]) -> Times:
    before, began = _children_s(), time.perf_counter()
    subprocess.run(command, env={**os.environ, **environment}, stdout=subprocess.DEVNULL, check=True)
    return Times(time.perf_counter() - began, _children_s() - before)


def _children_s() -> float:
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


SECTION = Declared("how long a person waits for `iort`", run, dollars=0.001)
