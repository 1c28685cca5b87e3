"""Processor time and memory of a process and all that it has started, from Linux' /proc."""

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
    """Of one process; nothing of one that is gone. What its ended children used is in its own."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return Usage(0.0, 0.0)
    # proc(5): utime, stime, cutime and cstime are fields 14 to 17, rss is 24; the state is 3.
    ticks = sum(int(field) for field in fields[11:15])
    return Usage(ticks / _TICKS, int(fields[21]) * _PAGE_MB)


def descendants(pid: int) -> list[int]:
    """Every process below ``pid``, itself not among them."""
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
    """Of all that ``pid`` has started together."""
    return sum((of(child) for child in descendants(pid)), Usage(0.0, 0.0))
