"""What an analysis of drives can say: its parameters, and the kinds of its findings.

A miner's estimate is an entry of `PARAMETERS`, a finding's kind one of `KINDS`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from iort_contract.catalog.kinds import KINDS

__all__ = ["KINDS", "PARAMETERS", "Parameter"]


@dataclass(frozen=True)
class Parameter:
    """A number that is estimated from a drive, with its unit.

    ``worse`` is the direction of a change for the worse; ``kind`` names the finding about such a change,
    empty if a change is no finding. A change counts from ``least`` in the unit and from ``least_share`` of
    the baseline on: less means nothing on a car, and healthy drives differ by a third of it. ``fields`` are
    those of the VESC that it was estimated from.
    """

    name: str
    unit: str
    meaning: str
    worse: Literal["up", "down", "either"] = "either"
    kind: str = ""
    fields: tuple[str, ...] = ()
    least: float = 0.0
    least_share: float = 0.2

    def least_change(self, baseline: float) -> float:
        """The smallest change from a baseline that means something, in the unit."""
        return max(self.least, self.least_share * abs(baseline))


# One group a miner of analysis/iort_analysis/mining.
_BATTERY = (
    Parameter(
        "battery_resistance_ohm",
        "ohm",
        "internal resistance of the battery and its wires",
        worse="up",
        kind="battery_worn",
        fields=("voltage_input", "current_input"),
    ),
)

PARAMETERS = {parameter.name: parameter for parameter in (*_BATTERY,)}
