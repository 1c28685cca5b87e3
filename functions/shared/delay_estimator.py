"""Estimates the extra delay of a message from the car to the cloud, regardless of the car's clock."""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass

_ROBOTS = 1000
_WINDOW_MS = 15_000


@dataclass
class _Run:
    """The fastest message of the current window and of the previous one."""

    boot: str
    began_ms: int
    fastest_us: int
    fastest_before_us: int


class DelayEstimator:
    """Compares each message with the fastest of its run in the last 15 to 30 s.

    Both contain the difference between the car's clock and the cloud's, so it cancels out. It misses a delay
    that all messages of half a minute share, and that of the first message of a run or of a new environment.
    It serves the cars that do not know their clock offset (`iort_contract.LiveSample`). After a car's clock
    is set back, its messages look late until the window has passed. Each environment keeps one, for the
    thousand robots that sent last, and the latest run of each: robots know each other's run names, and must
    not act for another.
    """

    def __init__(self) -> None:
        self._runs: OrderedDict[str, _Run] = OrderedDict()

    def excess_us(self, robot: str, boot: str, sent_us: int, received_ms: int) -> int:
        """Note a message of a robot's run; return its delay above the fastest, in microseconds."""
        leg_us = received_ms * 1000 - sent_us
        run = self._runs.pop(robot, None)
        if run is None or run.boot != boot:
            run = _Run(boot, received_ms, leg_us, leg_us)
        self._runs[robot] = run
        if len(self._runs) > _ROBOTS:
            self._runs.popitem(last=False)
        if received_ms - run.began_ms >= _WINDOW_MS:
            run.began_ms, run.fastest_before_us, run.fastest_us = received_ms, run.fastest_us, leg_us
        run.fastest_us = min(run.fastest_us, leg_us)
        return leg_us - min(run.fastest_us, run.fastest_before_us)
