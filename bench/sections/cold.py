"""The cost of a cold start of every function as it is deployed.

Each function is started by AWS' own runtime interface client on a Runtime API of this machine, with the
layer, and answers one event. Stand-ins for the services that it calls answer at once. The operating system
measures the processor time of all threads. On AWS the memory size gives a function its share of a processor:
the table scales the time by this share, for a processor as fast as this one. Nothing is throttled here.
"""

from __future__ import annotations

import compileall
import platform
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory

from bench.report import Report, Section
from bench.sections import Declared, Option
from testkit import ROOT
from testkit.deployed import events, functions
from testkit.runtime import Function, RuntimeFailedError, link_runtime, started
from testkit.target import Say, Target
from testkit.waiting import InstrumentError

LAYER = ROOT / "build" / "layer" / "local"
# "At 1,769 MB, a function has the equivalent of one vCPU": Lambda, "Configure memory".
ONE_VCPU_MB = 1769


def run(_target: Target | None, say: Say, *, rounds: int) -> Section:
    """Start every function so often; the medians are shown."""
    if not LAYER.is_dir():
        raise InstrumentError(f"{LAYER} is not there: run `make setup`")
    section, rows = Section("cold", "Cold starts"), []
    with TemporaryDirectory() as name:
        folder = Path(name)
        # AWS' own packages are taken to be compiled there, as those of a Python are that has run once.
        for package in link_runtime(folder / "runtime"):
            compile_ = compileall.compile_dir if package.is_dir() else compileall.compile_file
            compile_(package, quiet=2)
        for function in functions(folder / "functions", LAYER).values():
            say(function.name)
            starts = [_start(function) for _ in range(rounds)]
            start_ms, first_ms, peak_mb = (median(values) for values in zip(*starts, strict=True))
            cold_s = (start_ms + first_ms) / min(1.0, function.memory_mb / ONE_VCPU_MB) / 1000
            times = f"{start_ms:.0f} ms", f"{first_ms:.0f} ms", f"{cold_s:.2f} s"
            rows.append([function.name, f"{function.memory_mb} MB", *times, f"{peak_mb:.0f} MB"])
            section.raw[function.name] = {"start_ms": start_ms, "first_ms": first_ms, "cold_s": cold_s}
    head = ["function", "memory", "start", "first event", "at its share", "resident"]
    section.table(f"Python {platform.python_version()}, {platform.machine()}", head, rows)
    return section


def _start(function: Function) -> tuple[float, float, float]:
    """Processor time until the function asks for an event, and for the first one, in ms; its peak memory."""
    with TemporaryDirectory() as folder, started(function, Path(folder)) as environment:
        answer = environment.invoke(events()[function.name])
        if answer.error_type:
            raise RuntimeFailedError(f"{function.name}: {answer.document}")
        first_ms = environment.cpu_ms() - environment.start_cpu_ms
        return environment.start_cpu_ms, first_ms, environment.peak_mb()


SECTION = Declared(
    "a cold start of every function, under AWS' runtime client",
    run,
    (Option("ROUNDS", int, 5, "starts of each"),),
    Report("cold", "Cold starts", "make bench ONLY=cold"),
    cloud=False,
)
