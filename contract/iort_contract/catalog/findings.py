"""What an analysis of drives can say: its parameters, and the kinds of its findings.

A miner's estimate is an entry of `PARAMETERS`, a finding's kind one of `KINDS`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from iort_contract.catalog.kinds import KINDS

__all__ = [
    "GROUPS",
    "KINDS",
    "LAPS_TABLE",
    "PARAMETERS",
    "PLACES_TABLE",
    "STYLES",
    "STYLE_TABLE",
    "Parameter",
]


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

_LAPS = (
    Parameter("lap_best_s", "s", "time of the best lap", worse="up"),
    Parameter("lap_mean_s", "s", "mean time of the complete laps", worse="up"),
    Parameter("lap_distance_m", "m", "mean length of the complete laps"),
    Parameter("lap_energy_wh", "Wh", "mean energy of a lap, out of the battery", worse="up"),
    Parameter("lap_energy_wh_per_km", "Wh/km", "mean energy of a lap for its length", worse="up"),
)
# The tables of laps: what each took, and when it passed each place.
LAPS_TABLE, PLACES_TABLE = "laps", "lap_places"
# How a car is driven, over half a second; `mining.style` says when each is.
STYLES = {
    "standing": "the car stands",
    "hard braking": "the speed falls fast",
    "hard accelerating": "the speed rises fast",
    "corner at the limit": "a corner with nearly all the grip that the drive used",
    "cornering": "a corner below that",
    "steady fast": "a speed near the drive's highest, held",
    "steady slow": "a lower speed, held",
}
STYLE_TABLE = "style"
_STYLES = tuple(
    Parameter(f"style_{style.replace(' ', '_')}_share", "1", f"share of time: {meaning}")
    for style, meaning in STYLES.items()
)

# The groups in the order in which a person reads them.
GROUPS = {"Battery": _BATTERY, "Laps": _LAPS, "Driving style": _STYLES}
PARAMETERS = {parameter.name: parameter for group in GROUPS.values() for parameter in group}
