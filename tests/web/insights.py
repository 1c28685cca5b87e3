"""What the analysis says of a lab's cars: findings, drives and laps, as the page's server answers."""

from __future__ import annotations

import math
import time
from typing import TYPE_CHECKING

from iort_contract.catalog.analysis.kinds import KINDS
from iort_contract.catalog.analysis.parameters import GROUPS, PARAMETERS, STYLE_GROUP
from iort_contract.catalog.vesc import VESC_STREAM

if TYPE_CHECKING:
    from collections.abc import Mapping

    from iort_contract.messages.analysis.insights import (
        DeltaAnswer,
        DriveEntry,
        EstimateEntry,
        FindingEntry,
        InsightsAnswer,
        LapsAnswer,
    )

_DAY_US = 86_400_000_000
_NEWEST_US = round(time.time() - 3600) * 1_000_000
_LAP_S = 12.0
_PLACES = 200


def _estimate(value: float, either: float, unit: str) -> EstimateEntry:
    return {"value": value, "low": value - either, "high": value + either, "unit": unit}


def drive(days_ago: int, *, failed: str = "", robot: str = "car-1") -> DriveEntry:
    start_us = _NEWEST_US - days_ago * _DAY_US
    grown = 0.04 + 0.003 * max(0, 5 - days_ago)
    shares = [0.05, 0.16, 0.2, 0.12, 0.27, 0.14, 0.06]
    styles = {
        name: _estimate(share, share / 9, "1")
        for name, share in zip((p.name for p in GROUPS[STYLE_GROUP]), shares, strict=True)
    }
    return {
        "robot": robot,
        "from_us": start_us,
        "to_us": start_us + 600_000_000,
        "samples": 42_000,
        "failed": failed,
        "repairs": {"outlier": 12, "gap": 1},
        "estimates": {}
        if failed
        else {
            "battery_resistance_ohm": _estimate(grown, 0.002, "ohm"),
            "lap_best_s": _estimate(11.3 + 0.1 * math.sin(days_ago), 0.01, "s"),
            "lap_mean_s": _estimate(12 + 0.1 * math.sin(days_ago), 0.2, "s"),
            **styles,
        },
        "missing": {} if failed else {"lap_energy_wh": "needs voltage and current of the battery"},
    }


def finding(kind: str, **given: object) -> FindingEntry:
    entry = KINDS[kind]
    return {
        "id": kind,
        "robot": "car-1",
        "start_us": _NEWEST_US,
        "from_us": _NEWEST_US + 60_000_000,
        "to_us": _NEWEST_US + 90_000_000,
        "kind": kind,
        "severity": entry.severity,
        "meaning": entry.meaning,
        "action": entry.action,
        "subject": "battery_resistance_ohm",
        "stream": VESC_STREAM,
        "fields": ["voltage_input", "current_input"],
        "text": "the internal resistance is 55 mΩ, half again of what it was",
        "effect": _estimate(0.015, 0.003, "ohm"),
        "baseline": _estimate(0.04, 0.003, "ohm"),
        "q": 0.002,
        **given,
    }  # type: ignore[typeddict-item]  # of any kind


def insights(asked: Mapping[str, str]) -> InsightsAnswer:
    robot = asked.get("robot", "car-1")
    groups = {
        group: {p.name: {"unit": p.unit, "meaning": p.meaning, "worse": p.worse} for p in parameters}
        for group, parameters in GROUPS.items()
    }
    findings = [
        finding("battery_worn", robot=robot),
        finding("battery_worn", robot=robot, severity="serious", baseline=None, q=None, id="other"),
    ]
    drives = [drive(i, robot=robot) for i in range(6)]
    failed = drive(6, failed="the Lambda function ran out of memory", robot=robot)
    assert set(drives[0]["estimates"]) < PARAMETERS.keys()
    return {"findings": findings, "drives": [*drives, failed], "groups": groups}


def laps(asked: Mapping[str, str]) -> LapsAnswer:
    start_us = int(asked["from_us"])
    times = [_LAP_S + 0.3 * math.sin(i) for i in range(9)]
    return {
        "laps": [
            {
                "lap": i + 1,
                "from_us": start_us + round(sum(times[:i]) * 1e6),
                "to_us": start_us + round(sum(times[: i + 1]) * 1e6),
                "time_s": time_s,
                "distance_m": 47.5,
                "energy_wh": 0.06,
                "energy_wh_per_km": 1.27,
                "mean_speed_mps": 47.5 / time_s,
                "top_speed_mps": 6.5,
                "complete": i != 3,
                "best": time_s == min(times),
            }
            for i, time_s in enumerate(times)
        ],
        "method": "gate",
        "confidence": 0.89,
        "reason": "",
        "estimates": {"lap_best_s": _estimate(min(times), 0.004, "s"), "lap_mean_s": _estimate(12, 0.1, "s")},
    }


def delta(asked: Mapping[str, str]) -> DeltaAnswer:
    shares = [i / _PLACES for i in range(_PLACES + 1)]
    return {
        "places": [47.5 * share for share in shares],
        "unit": "m",
        "delta_s": [int(asked["other"]) / 50 * share + 0.05 * math.sin(9 * share) for share in shares],
        "one_mps": [4 + 2 * math.cos(12 * share) for share in shares],
        "other_mps": [4 + 1.9 * math.cos(12 * share + 0.1) for share in shares],
    }
