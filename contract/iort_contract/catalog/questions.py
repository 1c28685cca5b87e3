"""The questions that a robot may ask the function answer.

To add one, add an entry, and ``functions/shared/questions/<name>.py`` with its answer.
"""

from __future__ import annotations

from dataclasses import dataclass

from iort_contract.messages.ask import MAX_INLINE_BYTES
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

QUESTIONS = {question.name: question for question in (CALIBRATION,)}
