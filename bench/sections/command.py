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

ROBOT = "bench-command"
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
    robot = target.robot(ROBOT).robot
    say("storing a minute of one robot")
    stored_drive.store(target, robot, stored_drive.simulated(60 * RATE_HZ))
    iort = [str(Path(sys.executable).parent / "iort"), *_options(target)]
    query = [*iort, "query", robot, VESC_STREAM, "--last", "3m"]
    tab = {"_IORT_COMPLETE": "complete_bash", "XDG_CACHE_HOME": str(target.folder / "cache")}
    ways: dict[str, tuple[list[str], Mapping[str, str]]] = {
        _PYTHON: ([sys.executable, "-c", "pass"], {}),
        "iort --help": ([*iort, "--help"], {}),
        "iort query, a minute": (query, {}),
        "TAB: a verb": (iort[:1], tab | _line([*iort, "qu"])),
        "TAB: a robot": (iort[:1], tab | _line([*iort, "query", robot[:-1]])),
    }
    found: dict[str, list[Times]] = {name: [] for name in ways}
    for turn in range(REPEATS + 1):
        say(f"{turn} of {REPEATS}" if turn else "to warm up")
        for name, (command, environment) in ways.items():
            times = _timed(command, environment)
            found[name] += [times] if turn else []
    section = Section("command", "The command iort")
    report(section, found)
    return section


def report(section: Section, found: Mapping[str, list[Times]]) -> None:
    """Add the table and the ratios."""
    rows = []
    for name, times in found.items():
        _, wait = TARGETS.get(name, (0, ""))
        rows.append([name, *(f"{median(column):.3f} s" for column in zip(*times, strict=True)), wait])
    section.table(f"Median of {REPEATS}", ["command", "wall", "processor", "wanted"], rows)
    python = [[times.cpu_s] for times in found[_PYTHON]]
    for name, (most, _) in TARGETS.items():
        value = ratio([[times.cpu_s] for times in found[name]], python)
        section.ratio(f"{name}: processor / {_PYTHON}", value and round(value, 1), most)
    section.notes.append(
        "The names of robots come from a file that an earlier TAB has had written; only the first TAB waits "
        "for the cloud."
    )
    section.raw = {name: [times._asdict() for times in each] for name, each in found.items()}


def _options(target: Target) -> list[str]:
    if target.embedded is not None:
        return ["--local", "--embedded", str(target.embedded.folder / EMBEDDED.name)]
    chosen = {
        "--namespace": target.cloud.namespace,
        "--region": target.cloud.region,
        "--profile": target.cloud.profile,
    }
    return [part for name, value in chosen.items() if value for part in (name, value)]


def _line(words: list[str]) -> dict[str, str]:
    """What bash says of the line: its words, and that the last one is incomplete."""
    return {"COMP_WORDS": " ".join(words), "COMP_CWORD": str(len(words) - 1)}


def _timed(command: list[str], environment: Mapping[str, str]) -> Times:
    before, began = _children_s(), time.perf_counter()
    subprocess.run(command, env={**os.environ, **environment}, stdout=subprocess.DEVNULL, check=True)
    wall_s = time.perf_counter() - began
    return Times(round(wall_s, 4), round(_children_s() - before, 4))


def _children_s() -> float:
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


SECTION = Declared("how long a person waits for `iort`", run)
