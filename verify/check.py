"""One question to a deployment: the assumption, the answer, and the verdict."""

from __future__ import annotations

import enum
import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from bench.target import EMBEDDED, Target
from verify.assumption import Assumption
from verify.errors import CannotAskError

# Prefix of notes beside the answer, such as a version: they are reported, but not compared.
NOTE = "note_"
# Phases: the first deployment, and the same after a change to a key of the account's own.
FIRST, WITH_KEY = "first deployment", "with customer_key"


class Verdict(enum.Enum):
    """The outcome of a question."""

    AS_ASSUMED = "as assumed"
    DIFFERS = "differs"
    NOT_ASKED = "not asked"
    FAILED = "failed"


@dataclass(frozen=True, kw_only=True)
class Check(Assumption):
    """An assumption, with the code that asks a deployment.

    ``expected`` is the assumption as JSON values. ``ask`` returns the answer in the form of ``expected``,
    without secrets and without names or times that change between runs; keys that begin with `NOTE` are not
    compared. It removes everything that it creates, and raises `CannotAskError` if it cannot ask.
    ``not_embedded`` says why the embedded cloud cannot be asked; "" if it can.
    """

    expected: Mapping[str, Any]
    ask: Callable[[Target], Mapping[str, Any]]
    phase: str = FIRST
    not_embedded: str = ""


@dataclass(frozen=True, kw_only=True)
class Answer:
    """A question's outcome; ``expected`` is what it was compared with, and ``reason``
    says why it was not asked, or how it failed."""

    check: Check
    verdict: Verdict
    expected: Mapping[str, Any] | None = None
    seen: Mapping[str, Any] | None = None
    reason: str = ""
    took_s: float = 0.0


def ask(
    check: Check, target: Target, clock: Callable[[], float], expected: Mapping[str, Any] | None = None
) -> Answer:
    """Ask one question. A service error is an answer too, and never ends the run.

    ``expected`` replaces the check's own value if AWS has been measured.
    """
    if target.kind == EMBEDDED and check.not_embedded:
        return Answer(check=check, verdict=Verdict.NOT_ASKED, reason=check.not_embedded)
    began = clock()
    try:
        seen = json.loads(json.dumps(check.ask(target)))
    except CannotAskError as error:
        return Answer(check=check, verdict=Verdict.NOT_ASKED, reason=str(error), took_s=clock() - began)
    except Exception as error:  # noqa: BLE001 - an answer of another form is one too, and the next are asked
        reason = f"{type(error).__name__}: {error}"
        return Answer(check=check, verdict=Verdict.FAILED, reason=reason, took_s=clock() - began)
    expected = check.expected if expected is None else expected
    verdict = Verdict.AS_ASSUMED if compared(seen) == compared(expected) else Verdict.DIFFERS
    return Answer(check=check, verdict=verdict, expected=expected, seen=seen, took_s=clock() - began)


def compared(answer: Mapping[str, Any]) -> dict[str, Any]:
    """An answer without its notes."""
    return {name: value for name, value in answer.items() if not name.startswith(NOTE)}
