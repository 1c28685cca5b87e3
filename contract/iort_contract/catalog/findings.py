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

PARAMETERS = {parameter.name: parameter for parameter in (*_BATTERY,)}

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
