"""One try of a failure while a car is driven: whether its stop came in time, and if not, what happened."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

from iort_contract.catalog.streams import DRIVE_STREAM
from iort_station import data
from iort_station.cloud import Cloud

# What is told of a try that failed: from before the failure until after the stop.
_BEFORE_S, _AFTER_S = 1.0, 2.0
# The record may lag behind by a batch.
_MARGIN_S = 5.0


class Heard(NamedTuple):
    """A motion command at the ROS subscriber: `time.monotonic`, `time.time`, and the speed."""

    at: float
    wall_s: float
    speed: float


@dataclass(frozen=True)
class Try:
    """A failure at ``failed`` (its speed is 0), and what the ROS subscriber heard of the car around it."""

    failure: str
    number: int
    failed: Heard
    heard: Sequence[Heard] = field(repr=False)
    lease_s: float

    @property
    def driven(self) -> bool:
        """Whether the car was driven when it failed, or after; otherwise it is no try."""
        before = [one.speed for one in self.heard if one.at <= self.failed.at]
        return before[-1:] != [0.0] or any(one.at > self.failed.at and one.speed for one in self.heard)

    @property
    def first(self) -> Heard | None:
        """The first stop after the failure."""
        return next((one for one in self.heard if one.at > self.failed.at and one.speed == 0), None)

    @property
    def late_s(self) -> float | None:
        """From the failure, or the last motion if that was later, to the stop after it; None without one."""
        last = max((one.at for one in self.heard if one.speed != 0), default=self.failed.at)
        stop = next((one for one in self.heard if one.at > max(last, self.failed.at)), None)
        return None if stop is None else stop.at - max(last, self.failed.at)

    @property
    def moved_again_s(self) -> float | None:
        """From the first stop after the failure to the last motion after it; None if there was none."""
        first = self.first
        after = [one.at for one in self.heard if first and one.at > first.at and one.speed != 0]
        return after[-1] - first.at if first is not None and after else None

    @property
    def why(self) -> str:
        """Why the try failed; empty if it did not."""
        if self.late_s is None:
            return "no stop"
        reasons = []
        if self.late_s > self.lease_s:
            reasons.append(f"the stop came {self.late_s * 1000:.0f} ms after the last motion or the failure")
        if self.moved_again_s is not None:
            reasons.append(f"a motion came {self.moved_again_s * 1000:.0f} ms after the first stop")
        return "; ".join(reasons)

    def lines(self, cloud: Cloud, robot: str) -> Iterator[str]:
        """What happened, in ms from the failure: the commands as the car recorded them, and as ROS heard
        them."""
        told = [(0.0, f"{self.failure}: {self.why}")]
        told += [(one.wall_s - self.failed.wall_s, f"ROS heard {one.speed:g} m/s") for one in self.heard]
        since, until = (self.failed.wall_s + by for by in (-_BEFORE_S - _MARGIN_S, _AFTER_S + _MARGIN_S))
        recorded = data.query(cloud, robot, DRIVE_STREAM, round(since * 1e6), round(until * 1e6))
        columns = recorded.columns
        for i, t_us in enumerate(recorded.times_us.tolist()):
            at_s, sent_s = (us / 1e6 - self.failed.wall_s for us in (t_us, columns["sent_us"][i]))
            outcome, seq, left = (columns[name][i] for name in ("outcome", "seq", "lease_left_ms"))
            command = f"command {seq:.0f} of {columns['session'][i][:4]}, {columns['speed'][i]} m/s"
            times = f"sent at {sent_s * 1000:.0f} ms, lease left {left:.0f} ms"
            told.append((at_s, f"car: {outcome}, {command}, {times}"))
        for at_s, text in sorted(told):
            if -_BEFORE_S <= at_s <= _AFTER_S:
                yield f"{at_s * 1000:8.0f} ms  {text}"
