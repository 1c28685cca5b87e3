"""Reads processor time to the microsecond from Linux' scheduler."""

from __future__ import annotations

from pathlib import Path

from bench.meters.usage import descendants


def of_tree(pid: int) -> dict[int, int]:
    """Return the processor time so far, in ns, of every thread of every process below ``pid``."""
    return _threads(descendants(pid))


def of_process(pid: int) -> dict[int, int]:
    """Return the processor time so far, in ns, of every thread of one process."""
    return _threads([pid])


def _threads(pids: list[int]) -> dict[int, int]:
    found: dict[int, int] = {}
    for child in pids:
        try:
            tasks = list(Path(f"/proc/{child}/task").iterdir())
        except OSError:
            continue
        for task in tasks:
            try:
                found[int(task.name)] = int((task / "schedstat").read_text().split()[0])
            except (OSError, ValueError, IndexError):
                continue
    return found


def spent_ms(before: dict[int, int], after: dict[int, int]) -> float:
    """Return the ms between two readings; a new thread counts whole, an ended one not at all."""
    return sum(now - before.get(thread, 0) for thread, now in after.items()) / 1e6
