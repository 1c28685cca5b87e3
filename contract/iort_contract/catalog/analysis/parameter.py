"""A number that an analysis estimates from a drive."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True)
class Parameter:
    """A number that is estimated from a drive, with its unit.

    ``worse`` is the direction of a change for the worse; ``kind`` names the finding about such a change,
    empty if a change is no finding. A change counts from ``least`` in the unit and from ``least_share`` of
    the baseline on: less means nothing on a car, and healthy drives differ by a quarter. ``fields`` are
    those of the VESC that it was estimated from. A ``state`` is different after each drive by its nature.
    """

    name: str
    unit: str
    meaning: str
    worse: Literal["up", "down", "either"] = "either"
    kind: str = ""
    fields: tuple[str, ...] = ()
    least: float = 0.0
    least_share: float = 0.2
    state: bool = False

    def least_change(self, baseline: float) -> float:
        """The smallest change from a baseline that means something, in the unit."""
        return max(self.least, self.least_share * abs(baseline))
