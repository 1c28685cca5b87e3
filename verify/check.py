"""One question to a deployment: what the design assumes, what was seen, and the verdict."""

from __future__ import annotations

import enum
import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from bench.target import EMBEDDED, Target
from verify.assumption import Assumption
from verify.errors import CannotAskError

# What a question tells beside the answer, such as a version: in the report, and not compared.
NOTE = "note_"
# The deployment as it is made first, and after it was changed to a key of the account's own.
FIRST, WITH_KEY = "first deployment", "with customer_key"


class Verdict(enum.Enum):
    """The outcome of a question."""

    AS_ASSUMED = "as assumed"
    DIFFERS = "differs"
    NOT_ASKED = "not asked"
    FAILED = "failed"


@dataclass(frozen=True, kw_only=True)
class Check(Assumption):
    """An assumption, and how to ask a deployment for it.

    ``expected`` says the assumption in values of JSON. ``ask`` returns what was seen, in the form of
    ``expected``, without secrets and without names or times that change from run to run; keys that begin with
    `NOTE` are not compared. It cleans up what it makes, and raises `CannotAskError` where it cannot ask.
    ``not_embedded`` says why the embedded cloud cannot be asked; "" where it can.
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
    """Ask one question; an error of the services is an answer as well, and never ends the run.

    ``expected`` takes the place of the check's own where AWS has been measured.
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
