"""Calibration: the robot's latest parameters, from the analysis of its drives."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from functions.shared.questions import parameters
from functions.shared.questions.work import RefusedError
from iort_contract.messages.analysis.findings import encode_estimate
from iort_contract.messages.requests.ask import NO_DATA


def work(robot: str, _body: Mapping[str, Any]) -> dict[str, Any]:
    """Each parameter of the robot by its name, from the newest drive that has it."""
    latest = parameters.latest(robot)
    if not latest:
        raise RefusedError(NO_DATA, "no drive of this robot is analysed yet: `iort analyse`")
    return {
        "parameters": {
            name: {**encode_estimate(estimate), "drive": str(drive)}
            for name, (estimate, drive) in sorted(latest.items())
        }
    }
