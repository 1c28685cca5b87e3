"""One question to a deployment: the assumption of the design, the answer, and the verdict."""

from __future__ import annotations

import enum
import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from testkit.target import EMBEDDED, Target
from testkit.waiting import InstrumentError

# Prefix of notes beside the answer, such as a version: they are reported, but not compared.
NOTE = "note_"
# Phases: the first deployment, its change (a key of the account's own, everybody's identity), and its end.
FIRST, CHANGED, ENDED = "first deployment", "changed deployment", "end of the deployment"

Seen = Mapping[str, Any]
Ask = Callable[[Target], Seen]


class CannotAskError(InstrumentError):
    """A question cannot be asked here; the text says why."""


class Verdict(enum.Enum):
    """The outcome of a question."""

    AS_ASSUMED = "as assumed"
    DIFFERS = "differs"
    NOT_ASKED = "not asked"
    FAILED = "failed"


@dataclass(frozen=True, kw_only=True)
class Question:
    """One behaviour of AWS that the code relies on, and how a deployment is asked about it.

    ``name`` is ``subject.detail``; ``assumed`` is one to three sentences; ``relied_on_by`` are files of the
    repository. ``source`` names AWS' page; "" means that AWS does not document the behaviour. ``expected`` is
    the assumption as JSON values. ``not_embedded`` says why the embedded cloud cannot be asked; "" if it can.

    ``ask`` returns the answer in the form of ``expected``, without secrets and without names or times that
    change between runs; keys that begin with `NOTE` are not compared. It removes everything that it creates,
    and raises `CannotAskError` if it cannot ask.
    """

    name: str
    assumed: str
    expected: Seen
    relied_on_by: tuple[str, ...]
    ask: Ask
    source: str = ""
    phase: str = FIRST
    not_embedded: str = ""

    @property
    def subject(self) -> str:
        """The first part of the name."""
        return self.name.partition(".")[0]


def question(
    name: str,
    *,
    expected: Seen,
    relied_on_by: tuple[str, ...],
    source: str = "",
    phase: str = FIRST,
    not_embedded: str = "",
) -> Callable[[Ask], Question]:
    """Make a question of the function that asks it; the function's docstring is the assumption."""

    def made(ask: Ask) -> Question:
        return Question(
            name=name,
            assumed=" ".join((ask.__doc__ or "").split()),
            expected=expected,
            relied_on_by=relied_on_by,
            ask=ask,
            source=source,
            phase=phase,
            not_embedded=not_embedded,
        )

    return made


@dataclass(frozen=True, kw_only=True)
class Answer:
    """A question's outcome; ``expected`` is what it was compared with, and ``reason``
    says why it was not asked, or how it failed."""

    question: Question
    verdict: Verdict
    expected: Seen | None = None
    seen: Seen | None = None
    reason: str = ""
    took_s: float = 0.0


def ask(
    question: Question, target: Target, clock: Callable[[], float], expected: Seen | None = None
) -> Answer:
    """Ask one question. A service error is an answer too, and never ends the run.

    ``expected`` replaces the question's own value if AWS has been measured.
    """
    if target.kind == EMBEDDED and question.not_embedded:
        return Answer(question=question, verdict=Verdict.NOT_ASKED, reason=question.not_embedded)
    began = clock()

    def ended(verdict: Verdict, reason: str) -> Answer:
        return Answer(question=question, verdict=verdict, reason=reason, took_s=clock() - began)

    try:
        seen = json.loads(json.dumps(question.ask(target)))
    except CannotAskError as error:
        return ended(Verdict.NOT_ASKED, str(error))
    except Exception as error:  # noqa: BLE001 - an answer of another form is one too, and the next are asked
        return ended(Verdict.FAILED, f"{type(error).__name__}: {error}")
    expected = question.expected if expected is None else expected
    verdict = Verdict.AS_ASSUMED if compared(seen) == compared(expected) else Verdict.DIFFERS
    return Answer(question=question, verdict=verdict, expected=expected, seen=seen, took_s=clock() - began)


def compared(answer: Seen) -> dict[str, Any]:
    """An answer without its notes."""
    return {name: value for name, value in answer.items() if not name.startswith(NOTE)}
