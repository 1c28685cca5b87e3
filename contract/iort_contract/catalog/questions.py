"""The questions that a robot may ask the function answer.

To add one, add an entry, and a function with its answer in ``functions/shared/questions.py``.
"""

from __future__ import annotations

from dataclasses import dataclass

from iort_contract.messages.questions import MAX_INLINE_BYTES
from iort_contract.tables import ASKED_PREFIX


@dataclass(frozen=True)
class Question:
    """A question. A robot may ask it ``per_hour`` times in an hour of the clock.

    It takes the function up to ``timeout_s`` and ``memory_mb``; the function has what its largest question
    needs. A question or an answer above `MAX_INLINE_BYTES` is a file in the bucket.
    """

    name: str
    meaning: str
    per_hour: int
    timeout_s: int = 10
    memory_mb: int = 256
    max_question_bytes: int = 10 * 1024
    max_answer_bytes: int = MAX_INLINE_BYTES

    @property
    def hour_attribute(self) -> str:
        """The attribute of the robot's row with the hour that is counted, as ``2026-11-22T17`` in UTC."""
        return f"{ASKED_PREFIX}{self.name}_hour"

    @property
    def count_attribute(self) -> str:
        """The attribute of the robot's row with the questions of that hour."""
        return f"{ASKED_PREFIX}{self.name}_count"


CALIBRATION = Question(
    "calibration", "the robot's latest parameters, with their 90 % intervals and units", per_hour=60
)

RACELINE = Question(
    "raceline",
    "the line of least curvature around a track, with the fastest speeds along it",
    per_hour=20,
    timeout_s=50,
    memory_mb=1769,
    max_question_bytes=2 * 1024 * 1024,
    max_answer_bytes=2 * 1024 * 1024,
)

QUESTIONS = {question.name: question for question in (CALIBRATION, RACELINE)}


@dataclass(frozen=True)
class CarLimit:
    """A limit of the car in the question `RACELINE`: its unit, its default for a 1:10 car, and its bounds.

    The robot's own calibration goes before the default, if it has one: the parameters in ``calibrated``.
    """

    name: str
    unit: str
    meaning: str
    default: float
    low: float
    high: float
    calibrated: tuple[str, ...] = ()


# At this share of its open-circuit voltage a battery still gives power; at less the controller ends it.
SAG = 0.8
CAR_LIMITS = {
    limit.name: limit
    for limit in (
        CarLimit("width_m", "m", "the car's width, and what it should keep from the edges", 0.3, 0.01, 10),
        CarLimit("mass_kg", "kg", "the mass that moves", 3.5, 0.1, 10_000, ("effective_mass_kg",)),
        CarLimit("grip", "1", "the tyres' coefficient of friction on this floor", 0.8, 0.05, 5),
        CarLimit(
            "power_w",
            "W",
            "the most power at the wheels; calibrated, what the battery gives at 80 % of its voltage",
            300,
            1,
            2e6,
            ("battery_open_voltage_v", "battery_resistance_ohm"),
        ),
        CarLimit("accel_mps2", "m/s2", "the motor's acceleration, at most", 6, 0.1, 100),
        CarLimit("brake_mps2", "m/s2", "the brakes' deceleration, at most", 6, 0.1, 100),
        CarLimit("speed_mps", "m/s", "the speed, at most", 10, 0.1, 150),
        CarLimit("rolling_n", "N", "the force that rolling takes", 0, 0, 10_000, ("friction_n",)),
        CarLimit(
            "drag_n_s2_per_m2",
            "N s2/m2",
            "the force of the air, by the square of the speed",
            0,
            0,
            100,
            ("drag_n_s2_per_m2",),
        ),
    )
}
