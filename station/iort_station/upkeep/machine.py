"""Facts of the machine that keeps a cloud: memory, processes, whether a time server sets its clock."""

from __future__ import annotations

import ctypes
import os
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

_PROC = Path("/proc")
# adjtimex(2): the clock's state without a server of time, and room for its struct.
_TIME_ERROR, _TIMEX_BYTES = 5, 512


class Memory(NamedTuple):
    """The machine's memory in bytes."""

    total: int
    available: int


def memory() -> Memory | None:
    """The machine's memory; None where it cannot be told, which is on systems other than Linux."""
    found = dict(_lines(_PROC / "meminfo"))
    return Memory(found["MemTotal"], found["MemAvailable"]) if "MemAvailable" in found else None


def runs(pid: int) -> bool:
    """Whether there is such a process."""
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        pass
    return True


def resident_bytes(pid: int) -> int | None:
    """The memory of a process and of those that it started; None where it cannot be told."""
    children: dict[int, list[int]] = {}
    for status in _PROC.glob("[0-9]*/status"):
        with suppress(OSError):
            parent = next(line for line in status.read_text().splitlines() if line.startswith("PPid:"))
            children.setdefault(int(parent.split()[1]), []).append(int(status.parent.name))
    found, waiting = None, [pid]
    while waiting:
        one = waiting.pop()
        size = dict(_lines(_PROC / str(one) / "status")).get("VmRSS")
        found = found if size is None else (found or 0) + size
        waiting += children.get(one, [])
    return found


def clock_is_set() -> bool | None:
    """Whether the kernel knows that a server of time sets the clock; None where it cannot be told."""
    try:
        return bool(ctypes.CDLL(None).adjtimex(ctypes.create_string_buffer(_TIMEX_BYTES)) != _TIME_ERROR)
    except (AttributeError, OSError):
        return None


def _lines(path: Path) -> Iterator[tuple[str, int]]:
    """The sizes of one of the kernel's files, in bytes."""
    with suppress(OSError):
        for line in path.read_text().splitlines():
            name, _, value = line.partition(":")
            if value.endswith(" kB"):
                yield name, int(value.split()[0]) * 1024
