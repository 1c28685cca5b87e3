"""What answers a question, and how it says that it does not."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Mapping
from typing import Any

from iort_contract.catalog.questions import Question
from iort_contract.messages.requests.ask import Refusal

# Makes the answer's body of a robot's name and the question's body. May raise `RefusedError`.
Work = Callable[[str, Mapping[str, Any]], Mapping[str, Any]]


class RefusedError(Exception):
    """A question that is not answered: one of the contract's `REASONS`, and a text for a person."""

    def __init__(self, reason: str, text: str) -> None:
        super().__init__(text)
        self.refusal = Refusal(reason, text)


def work_of(question: Question) -> Work:
    """The function that answers a question of the catalogue.

    Its module is imported when it is first asked for, so that no question loads what another one needs.
    """
    work: Work = importlib.import_module(f"functions.shared.questions.{question.name}").work
    return work
