"""Reads processor time and memory of a process and its descendants from Linux' /proc."""

from __future__ import annotations

import os
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
    try:
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return Usage(0.0, 0.0)
    # proc(5): utime, stime, cutime and cstime are fields 14 to 17, rss is 24; the state is 3.
    ticks = sum(int(field) for field in fields[11:15])
    return Usage(ticks / _TICKS, int(fields[21]) * _PAGE_MB)


def descendants(pid: int) -> list[int]:
    """Return every process below ``pid``, without ``pid``."""
    parents: dict[int, list[int]] = {}
    for entry in Path("/proc").iterdir():
        if entry.name.isdecimal():
            try:
                fields = (entry / "stat").read_text().rpartition(")")[2].split()
            except OSError:
                continue
            parents.setdefault(int(fields[1]), []).append(int(entry.name))
    found, todo = [], [pid]
    while todo:
        children = parents.get(todo.pop(), [])
        found += children
        todo += children
    return found


def below(pid: int) -> Usage:
    """Return the usage of all descendants of ``pid`` together."""
    return sum((of(child) for child in descendants(pid)), Usage(0.0, 0.0))
