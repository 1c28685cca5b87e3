"""The questions that a robot may ask: each is a function of the cloud that answers on ``answer/...``.

To add one, add an entry, and ``functions/<name>.py`` with the answer.
"""

from __future__ import annotations

from dataclasses import dataclass

from iort_contract.messages.ask import MAX_INLINE_BYTES


@dataclass(frozen=True)
class Question:
    """A question. A robot may ask it ``per_hour`` times in an hour of the clock.

    The function has ``timeout_s`` and ``memory_mb``. A question or an answer above `MAX_INLINE_BYTES` is a
    file in the bucket; a function whose limits are below has no rights on the bucket. A function that
    ``calculates`` needs numpy.
    """

    name: str
    meaning: str
    per_hour: int
    timeout_s: int = 10
    memory_mb: int = 256
    max_question_bytes: int = 10 * 1024
    max_answer_bytes: int = MAX_INLINE_BYTES
    calculates: bool = False

    @property
    def hour_attribute(self) -> str:
        """The attribute of the robot's row with the hour that is counted, as ``2026-11-22T17`` in UTC."""
        return f"asked_{self.name}_hour"

    @property
    def count_attribute(self) -> str:
        """The attribute of the robot's row with the questions of that hour."""
        return f"asked_{self.name}_count"

    @property
    def by_file(self) -> bool:
        """Whether a question or an answer may be a file."""
        return max(self.max_question_bytes, self.max_answer_bytes) > MAX_INLINE_BYTES


CALIBRATION = Question(
    "calibration", "the robot's latest parameters, with their 90 % intervals and units", per_hour=60
)

QUESTIONS = {question.name: question for question in (CALIBRATION,)}
