"""What an analysis of drives can say: its parameters, and the kinds of its findings.

A miner's estimate is an entry of `PARAMETERS`, a finding's kind one of `KINDS`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True)
class Parameter:
    """A number that is estimated from a drive, with its unit.

    ``worse`` is the direction of a change for the worse; ``kind`` names the finding about such a change,
    empty if a change is no finding.
    """

    name: str
    unit: str
    meaning: str
    worse: Literal["up", "down", "either"] = "either"
    kind: str = ""


@dataclass(frozen=True)
class Kind:
    """A kind of finding. ``meaning`` says what happened, ``action`` what a person does, in Markdown.

    The operator gets a mail for a ``serious`` one.
    """

    name: str
    meaning: str
    action: str
    severity: Literal["info", "warning", "serious"] = "warning"


# One group a miner of analysis/iort_analysis/mining.
_BATTERY = (
    Parameter(
        "battery_resistance_ohm",
        "ohm",
        "internal resistance of the battery and its wires",
        worse="up",
        kind="battery_worn",
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

PARAMETERS = {parameter.name: parameter for parameter in (*_BATTERY, *_LAPS, *_STYLES)}

KINDS = {
    kind.name: kind
    for kind in (
        Kind(
            "battery_worn",
            "the battery's internal resistance has grown",
            "charge it fully and compare with another battery; replace it if the resistance stays",
        ),
        Kind(
            "analysis_failed",
            "a drive could not be analysed",
            "the text has the reason; the samples are kept, and `iort analyse` tries again",
        ),
    )
}
