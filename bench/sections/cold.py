"""The cost of a cold start of every function, with bytecode and without, in turns.

Each function is started by AWS' own runtime interface client on a Runtime API of this machine, with the
layer, and answers one event. Stand-ins for the services that it calls answer at once. The operating system
measures the processor time of all threads. On AWS the memory size gives a function its share of a processor:
the table scales the time by this share, for a processor as fast as this one. Nothing is throttled here.
"""

from __future__ import annotations

import compileall
import platform
import shutil
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from py_compile import PycInvalidationMode
from statistics import median
from tempfile import TemporaryDirectory

from bench.report import Report, Section
from bench.sections import Declared, Option
from bench.sections.utilisation import ONE_VCPU_MB
from testkit import ROOT
from testkit.deployed import events, functions
from testkit.runtime import Function, RuntimeFailedError, link_runtime, started
from testkit.target import Say, Target
from testkit.waiting import InstrumentError

LAYER = ROOT / "build" / "layer" / "local"
# What has bytecode: what is deployed is the second.
NOTHING, LAYER_ALONE, ALL = "none", "layer", "all"


@dataclass(frozen=True)
class Start:
    """Medians of one function: processor time until it asked for an event, and for the first one, with the
    bytecode of ``compiled``; the most memory resident."""

    function: str
    compiled: str
    memory_mb: int
    start_cpu_ms: float
    first_cpu_ms: float
    peak_mb: float

    @property
    def cold_ms(self) -> float:
        """Time from the start to the first answer, with the processor share of its memory size."""
        return (self.start_cpu_ms + self.first_cpu_ms) / min(1.0, self.memory_mb / ONE_VCPU_MB)


def run(_target: Target | None, say: Say, *, rounds: int) -> Section:
    """Start every function so often with each kind of bytecode."""
    if not LAYER.is_dir():
        raise InstrumentError(f"{LAYER} is not there: run `make setup`")
    try:
        starts = list(measure(rounds, say))
    except RuntimeFailedError as error:
        raise InstrumentError(str(error)) from error
    section = Section("cold", "Cold starts")
    section.table(
        f"Python {platform.python_version()}, {platform.machine()}",
        ["function", "memory", "bytecode", "start", "first event", "at its share", "resident"],
        (
            [
                start.function,
                f"{start.memory_mb} MB",
                start.compiled,
                f"{start.start_cpu_ms:.0f} ms",
                f"{start.first_cpu_ms:.0f} ms",
                f"{start.cold_ms / 1000:.2f} s",
                f"{start.peak_mb:.0f} MB",
            ]
            for start in starts
        ),
    )
    section.raw = {"starts": [{**asdict(start), "cold_ms": start.cold_ms} for start in starts]}
    return section


def measure(rounds: int, say: Say) -> Iterator[Start]:
    """Yield the figures of every function; the kinds of bytecode take turns."""
    with TemporaryDirectory() as name:
        folder = Path(name)
        # AWS' own packages are taken to be compiled there, as those of a Python are that has run once.
        for package in link_runtime(folder / "runtime"):
            compile_ = compileall.compile_dir if package.is_dir() else compileall.compile_file
            compile_(package, quiet=2)
        for function in functions(folder / "functions", LAYER).values():
            say(function.name)
            kinds = _kinds(function, folder)
            figures: dict[str, list[tuple[float, float, float]]] = {kind: [] for kind in kinds}
            for _ in range(rounds):
                for kind, one in kinds.items():
                    figures[kind].append(_start(one))
            for kind, several in figures.items():
                start, first, peak = (median(values) for values in zip(*several, strict=True))
                yield Start(function.name, kind, function.memory_mb, start, first, peak)


def _kinds(function: Function, folder: Path) -> dict[str, Function]:
    bare, code = folder / f"layer-{function.layer and function.layer.name}", folder / "code"
    if function.layer is not None and not bare.exists():
        shutil.copytree(function.layer, bare, ignore=shutil.ignore_patterns("__pycache__"))
    if not code.exists():
        shutil.copytree(function.code, code)
        # As the layer's is: never compared with the source.
        compileall.compile_dir(code, quiet=2, invalidation_mode=PycInvalidationMode.UNCHECKED_HASH)
    if function.layer is None:
        return {NOTHING: function, ALL: replace(function, code=code)}
    return {
        NOTHING: replace(function, layer=bare),
        LAYER_ALONE: function,
        ALL: replace(function, code=code),
    }


def _start(function: Function) -> tuple[float, float, float]:
    with TemporaryDirectory() as folder, started(function, Path(folder)) as environment:
        answer = environment.invoke(events()[function.name])
        if answer.error_type:
            raise RuntimeFailedError(f"{function.name}: {answer.document}")
        first_ms = environment.cpu_ms() - environment.start_cpu_ms
        return environment.start_cpu_ms, first_ms, environment.peak_mb()


SECTION = Declared(
    "a cold start of every function, under AWS' runtime client",
    run,
    (Option("ROUNDS", int, 5, "starts of each kind"),),
    Report("cold", "Cold starts", "make bench ONLY=cold"),
    cloud=False,
)
