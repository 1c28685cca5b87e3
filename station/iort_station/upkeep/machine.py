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


def family(pid: int) -> list[int]:
    """A process and those that it started, as far as they run; empty where that cannot be told."""
    children: dict[int, list[int]] = {}
    for status in _PROC.glob("[0-9]*/status"):
        with suppress(OSError):
            parent = next(line for line in status.read_text().splitlines() if line.startswith("PPid:"))
            children.setdefault(int(parent.split()[1]), []).append(int(status.parent.name))
    found = [pid] if (_PROC / str(pid)).exists() else []
    for one in found:
        found += children.get(one, [])
    return found


def resident_bytes(pid: int) -> int:
    """The memory of a process; 0 if it has ended."""
    return dict(_lines(_PROC / str(pid) / "status")).get("VmRSS", 0)


def processor_s(pid: int) -> float:
    """The processor time of a process so far; 0 if it has ended."""
    with suppress(OSError):
        # Behind the name, which may have spaces: "proc_pid_stat(5)".
        fields = (_PROC / str(pid) / "stat").read_text().rpartition(")")[2].split()
        return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
    return 0.0


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
