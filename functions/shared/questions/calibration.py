"""Calibration: the robot's latest parameters, from the analysis of its drives."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from typing import Any

from functions.shared.questions import parameters
from functions.shared.questions.work import RefusedError
from iort_contract.messages.analysis.findings import encode_estimate
from iort_contract.messages.requests.ask import NO_DATA


def work(robot: str, _body: Mapping[str, Any]) -> dict[str, Any]:
    """Each parameter of the robot by its name, from the newest drive that has it."""
    drives = parameters.newest_drives(robot)
    latest = parameters.latest(drives)
    if not drives:
        raise RefusedError(NO_DATA, "no drive of this robot is analysed yet: `iort analyse`")
    if not latest:
        reasons = Counter(reason for drive in drives for reason in set(drive.missing.values()))
        why = f", mostly because {reasons.most_common(1)[0][0]}" if reasons else ""
        raise RefusedError(NO_DATA, f"no parameter follows from the {len(drives)} analysed drives{why}")
    return {
        "parameters": {
            name: {**encode_estimate(estimate), "drive": str(drive)}
            for name, (estimate, drive) in sorted(latest.items())
        }
    }
