"""Reads processor time and memory of processes and their threads from Linux' /proc."""

from __future__ import annotations

import os
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

_TICKS = os.sysconf("SC_CLK_TCK")
_PAGE_MB = os.sysconf("SC_PAGE_SIZE") / 2**20


@dataclass(frozen=True)
class Usage:
    """Processor seconds since the start, and memory in use now."""

    cpu_s: float
    rss_mb: float

    def __add__(self, other: Usage) -> Usage:
        return Usage(self.cpu_s + other.cpu_s, self.rss_mb + other.rss_mb)


def of(pid: int) -> Usage:
    """Return the usage of one process with its ended children; 0 for an ended process."""
    fields = _stat(pid)
    if not fields:
        return Usage(0.0, 0.0)
    # proc(5): utime, stime, cutime and cstime are fields 14 to 17, rss is 24; the state is 3.
    return Usage(sum(map(int, fields[11:15])) / _TICKS, int(fields[21]) * _PAGE_MB)


def below(pid: int) -> Usage:
    """Return the usage of all descendants of ``pid`` together."""
    return sum(map(of, descendants(pid)), Usage(0.0, 0.0))


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


def spent_ms(before: dict[int, int], after: dict[int, int]) -> float:
    """Return the ms between two readings; a new thread counts whole, an ended one not at all."""
    return sum(now - before.get(thread, 0) for thread, now in after.items()) / 1e6


def _stat(pid: int) -> list[str]:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return []
