"""One question to a deployment: the assumption of the design, the answer, and the verdict."""

from __future__ import annotations

import enum
import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from testkit.target import EMBEDDED, Target
from verify.lab import CannotAskError, Lab

# Prefix of notes beside the answer, such as a version: they are reported, but not compared.
NOTE = "note_"
# Phases: the first deployment, its change (a key of the account's own, everybody's identity), and its end.
FIRST, CHANGED, ENDED = "first deployment", "changed deployment", "end of the deployment"
# Where AWS documents what: a page is named by its guide and its file, such as "iot:mqtt".
_AWS = "https://docs.aws.amazon.com"
GUIDES = {
    "cfn": f"{_AWS}/AWSCloudFormation/latest/TemplateReference",
    "cloudwatch": f"{_AWS}/AmazonCloudWatch/latest/monitoring",
    "cloudwatch-api": f"{_AWS}/AmazonCloudWatch/latest/APIReference",
    "cognito": f"{_AWS}/cognito/latest/developerguide",
    "dynamodb": f"{_AWS}/amazondynamodb/latest/developerguide",
    "dynamodb-api": f"{_AWS}/amazondynamodb/latest/APIReference",
    "iot": f"{_AWS}/iot/latest/developerguide",
    "iot-api": f"{_AWS}/iot/latest/apireference",
    "kvs": f"{_AWS}/kinesisvideostreams/latest/dg",
    "lambda": f"{_AWS}/lambda/latest/dg",
    "quotas": f"{_AWS}/general/latest/gr",
    "s3": f"{_AWS}/AmazonS3/latest/userguide",
    "s3-api": f"{_AWS}/AmazonS3/latest/API",
    "scheduler": f"{_AWS}/scheduler/latest/UserGuide",
    "sqs": f"{_AWS}/AWSSimpleQueueService/latest/SQSDeveloperGuide",
    "states": f"{_AWS}/step-functions/latest/dg",
    "states-api": f"{_AWS}/step-functions/latest/apireference",
    "webrtc": f"{_AWS}/kinesisvideostreams-webrtc-dg/latest/devguide",
}

Seen = Mapping[str, Any]
Ask = Callable[[Lab], Seen]


class Verdict(enum.Enum):
    """The outcome of a question."""

    AS_ASSUMED = "as assumed"
    DIFFERS = "differs"
    NOT_ASKED = "not asked"
    FAILED = "failed"


@dataclass(frozen=True, kw_only=True)
class Question:
    """One behaviour of AWS that the code relies on, and how a deployment is asked about it.

    ``name`` is ``subject.detail``; ``assumed`` is one to three sentences. ``source`` names AWS' page; ""
    means that AWS does not document the behaviour. ``expected`` is the assumption as JSON values.
    ``not_embedded`` says why the embedded cloud cannot be asked; "" if it can.

    ``ask`` returns the answer in the form of ``expected``, without secrets and without names or times that
    change between runs; keys that begin with `NOTE` are not compared. It raises `CannotAskError` if it cannot
    ask.
    """

    name: str
    assumed: str
    expected: Seen
    ask: Ask
    source: str = ""
    phase: str = FIRST
    not_embedded: str = ""

    @property
    def subject(self) -> str:
        """The first part of the name."""
        return self.name.partition(".")[0]


def question(name: str, *, expected: Seen, aws: str = "", **more: str) -> Callable[[Ask], Question]:
    """Make a question of the function that asks it; the function's docstring is the assumption.

    ``aws`` are the pages that document it, with spaces between.
    """

    def decorate(ask: Ask) -> Question:
        assumed = " ".join((ask.__doc__ or "").split())
        return Question(name=name, assumed=assumed, expected=expected, ask=ask, source=pages(aws), **more)

    return decorate


def pages(names: str) -> str:
    """The addresses of AWS' pages, in words. Raises `KeyError` for an unknown guide."""
    *others, last = [_page(name) for name in names.split()] or [""]
    return f"{', '.join(others)} and {last}" if others else last


def _page(name: str) -> str:
    guide, _, file = name.partition(":")
    return name if guide == "https" else f"{GUIDES[guide]}/{file}.html"


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
    """Ask one question, and undo what it made. A service error is an answer too, and never ends the run.

    ``expected`` replaces the question's own value if AWS has been measured.
    """
    if target.kind == EMBEDDED and question.not_embedded:
        return Answer(question=question, verdict=Verdict.NOT_ASKED, reason=question.not_embedded)
    began = clock()

    def ended(verdict: Verdict, **more: Any) -> Answer:
        return Answer(question=question, verdict=verdict, took_s=clock() - began, **more)

    try:
        with Lab(target) as lab:
            seen = json.loads(json.dumps(question.ask(lab)))
    except CannotAskError as error:
        return ended(Verdict.NOT_ASKED, reason=str(error))
    except Exception as error:  # noqa: BLE001 - an answer of another form is one too, and the next are asked
        return ended(Verdict.FAILED, reason=f"{type(error).__name__}: {error}")
    expected = question.expected if expected is None else expected
    same = compared(seen) == compared(expected)
    return ended(Verdict.AS_ASSUMED if same else Verdict.DIFFERS, expected=expected, seen=seen)


def compared(answer: Seen) -> dict[str, Any]:
    """An answer without its notes."""
    return {name: value for name, value in answer.items() if not name.startswith(NOTE)}
