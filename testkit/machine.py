"""Describes the machine and the versions behind a report, without names of hosts, people or folders."""

from __future__ import annotations

import os
import platform
import re
import subprocess
from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from datetime import datetime, timezone
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, NamedTuple

from testkit import ROOT

_PACKAGES = ("aws-cdk-lib", "boto3", "awsiotsdk", "awscrt", "ministack", "pubnub", "numpy", "playwright")


def describe() -> dict[str, Any]:
    """Cores, processor, memory, kernel, Python, packages, commit, load and date."""
    return {
        "date": datetime.now(timezone.utc).isoformat(timespec="seconds"),
        "cores": os.cpu_count(),
        "cpu": _line("/proc/cpuinfo", "model name"),
        "memory": _line("/proc/meminfo", "MemTotal"),
        "kernel": f"{platform.system()} {platform.release()}",
        "python": platform.python_version(),
        "packages": {name: found for name in _PACKAGES if (found := _version(name))},
        "commit": _commit(),
        "load_1min": round(os.getloadavg()[0], 2),
    }


def _line(path: str, name: str) -> str:
    try:
        lines = Path(path).read_text().splitlines()
    except OSError:
        return "unknown"
    return next((line.partition(":")[2].strip() for line in lines if line.startswith(name)), "unknown")


def _version(package: str) -> str | None:
    try:
        return version(package)
    except PackageNotFoundError:
        return None


def _commit() -> str:
    command = ["git", "describe", "--always", "--dirty"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    return done.stdout.strip() or "unknown"


_TICKS = os.sysconf("SC_CLK_TCK")
_PAGE_MB = os.sysconf("SC_PAGE_SIZE") / 2**20


@dataclass(frozen=True)
class Usage:
    """Processor seconds since the start, and memory in use now."""

    cpu_s: float
    rss_mb: float

    def __add__(self, other: Usage) -> Usage:
        return Usage(self.cpu_s + other.cpu_s, self.rss_mb + other.rss_mb)


def usage_of(pid: int) -> Usage:
    """Return the usage of one process with its ended children; 0 for an ended process."""
    fields = _stat(pid)
    if not fields:
        return Usage(0.0, 0.0)
    # proc(5): utime, stime, cutime and cstime are fields 14 to 17, rss is 24; the state is 3.
    return Usage(sum(map(int, fields[11:15])) / _TICKS, int(fields[21]) * _PAGE_MB)


def usage_below(pid: int) -> Usage:
    """Return the usage of all descendants of ``pid`` together."""
    return sum(map(usage_of, descendants(pid)), Usage(0.0, 0.0))


def usages(processes: Mapping[str, subprocess.Popen[str]]) -> dict[str, Usage]:
    """Return the usage of each process with its descendants: a script such as `rosbag` starts what works."""
    return {who: usage_of(one.pid) + usage_below(one.pid) for who, one in processes.items()}


def descendants(pid: int) -> list[int]:
    """Return every process below ``pid``, without ``pid``."""
    parents: dict[int, list[int]] = {}
    for entry in Path("/proc").iterdir():
        if entry.name.isdecimal() and (fields := _stat(int(entry.name))):
            parents.setdefault(int(fields[1]), []).append(int(entry.name))
    found, todo = [], [pid]
    while todo:
        children = parents.get(todo.pop(), [])
        found += children
        todo += children
    return found


def threads_ns(pids: Iterable[int]) -> dict[int, int]:
    """Return the processor time so far of every thread of the processes, in ns by Linux' scheduler."""
    found: dict[int, int] = {}
    for file in (file for pid in pids for file in Path(f"/proc/{pid}/task").glob("*/schedstat")):
        # A thread may end meanwhile.
        with suppress(OSError, IndexError):
            found[int(file.parent.name)] = int(file.read_text().split()[0])
    return found


class Threads(NamedTuple):
    """The threads of one name: their processor time in seconds, and how often they have waited."""

    cpu_s: float = 0.0
    waits: int = 0


def threads_of(pid: int) -> dict[str, Threads]:
    """Return what the threads of a process have taken so far, by their names in the kernel."""
    found: dict[str, Threads] = {}
    for folder in Path(f"/proc/{pid}/task").iterdir():
        name, status = ((folder / file).read_text() for file in ("comm", "status"))
        cpu_s = int((folder / "schedstat").read_text().split()[0]) / 1e9
        waits = int(re.findall(r"^voluntary_ctxt_switches:\s*(\d+)", status, re.MULTILINE)[0])
        before = found.get(name.strip(), Threads())
        found[name.strip()] = Threads(before.cpu_s + cpu_s, before.waits + waits)
    return found


def spent(
    before: Mapping[str, Threads], after: Mapping[str, Threads], seconds: float, messages: float
) -> dict[str, tuple[float, float]]:
    """Return, of each thread by its name, the us a message and the wake-ups a second between two readings."""
    none = Threads()
    return {
        name: (
            (now.cpu_s - before.get(name, none).cpu_s) / messages * 1e6,
            (now.waits - before.get(name, none).waits) / seconds,
        )
        for name, now in after.items()
    }


def spent_ms(before: dict[int, int], after: dict[int, int]) -> float:
    """Return the ms between two readings; a new thread counts whole, an ended one not at all."""
    return sum(now - before.get(thread, 0) for thread, now in after.items()) / 1e6


def _stat(pid: int) -> list[str]:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return []
