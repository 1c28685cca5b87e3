"""The report of a run, as JSON and as Markdown, without account numbers and secrets.

`make verify-aws KEEP=1` keeps AWS' answers in the repository: tests compare the embedded cloud with them, and
docs/explanation/assumptions.md names who measured them and when.
"""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from testkit.command import Table
from testkit.waiting import InstrumentError
from verify.question import NOTE, Answer, Verdict, compared

KEPT = Path(__file__).resolve().parent / "aws.json"
# An account number, an access key's id, PubNub's keys, a private key, a session token.
_SECRETS = (
    (re.compile(r"\b\d{12}\b"), "<account>"),
    (re.compile(r"\b(?:AKIA|ASIA)[A-Z0-9]{12,}\b"), "<access key>"),
    (re.compile(r"\b(?:pub|sub|sec)-c-[0-9A-Za-z-]{8,}"), "<PubNub key>"),
    (re.compile(r"-----BEGIN [A-Z ]+-----[^-]*-----END [A-Z ]+-----"), "<certificate or key>"),
    (re.compile(r"(?i)(X-Amz-(?:Signature|Credential|Security-Token)=)[^&\s\"]+"), r"\1<hidden>"),
)


@dataclass(frozen=True, kw_only=True)
class Run:
    """The asker, the cloud and the time; ``preflight`` are the preflight's lines."""

    target: str
    region: str
    by: str
    date: str
    version: str
    preflight: Sequence[str] = ()
    left_over: Sequence[str] = ()


@dataclass(frozen=True, kw_only=True)
class Measured:
    """The answers of one run on AWS; ``seen`` maps a question's name to its answer."""

    by: str = ""
    date: str = ""
    region: str = ""
    seen: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)


def load(path: Path = KEPT) -> Measured:
    """The kept answers; empty without a file. Raises `InstrumentError` for a file of another form."""
    if not path.exists():
        return Measured()
    try:
        report = json.loads(path.read_text())
        seen = {one["name"]: one["seen"] for one in report["answers"] if one["seen"] is not None}
        return Measured(by=report["by"], date=report["date"], region=report["region"], seen=seen)
    except (KeyError, TypeError, ValueError) as error:
        raise InstrumentError(f"{path} must be a report of verify: {error!r}") from error


def redacted(text: str) -> str:
    """The text without account numbers and credentials."""
    for pattern, instead in _SECRETS:
        text = pattern.sub(instead, text)
    return text


def write(folder: Path, run: Run, answers: Sequence[Answer]) -> None:
    """Write ``report.json`` and ``report.md`` into the folder."""
    folder.mkdir(parents=True, exist_ok=True)
    # A time with twelve digits or more is not an account; by `Question`, answers hold no times.
    (folder / "report.json").write_text(redacted(_as_json(run, answers)))
    (folder / "report.md").write_text(redacted(_as_markdown(run, answers)))


def _as_json(run: Run, answers: Sequence[Answer]) -> str:
    told = [
        {
            "name": answer.question.name,
            "verdict": answer.verdict.value,
            "assumed": answer.question.assumed,
            "expected": answer.question.expected,
            "seen": answer.seen,
            "reason": answer.reason,
            "took_s": round(answer.took_s, 1),
        }
        for answer in answers
    ]
    return json.dumps({**asdict(run), "answers": told}, indent=1) + "\n"


def _as_markdown(run: Run, answers: Sequence[Answer]) -> str:
    """The report for people: the verdicts first, then all answers that differ."""
    rows = [
        [one.question.name, one.verdict.value, f"{one.took_s:.1f} s", _cell(one.reason or _notes(one))]
        for one in answers
    ]
    parts = [
        f"# What {run.target} answered\n",
        (
            f"{run.date}, {run.region}, {run.version}, asked by {run.by or 'nobody named'}: "
            f"{summary(answers)}.\n"
        ),
        *(f"- preflight: {finding}" for finding in run.preflight),
        *(f"- left over: {name}" for name in run.left_over),
        "",
        Table("", ["question", "verdict", "took", "note"], rows).as_markdown(),
    ]
    for one in answers:
        if one.verdict is Verdict.DIFFERS:
            differing = [[_cell(cell) for cell in row] for row in differences(one)]
            parts += ["", f"## {one.question.name}", "", one.question.assumed, ""]
            parts.append(Table("", ["key", "expected", "seen"], differing).as_markdown())
    return "\n".join(parts) + "\n"


def differences(answer: Answer) -> list[tuple[str, str, str]]:
    """Each key of an answer that is not as expected: its name, the expected and the seen value."""
    expected, seen = compared(answer.expected or {}), compared(answer.seen or {})
    rows = [
        (key, json.dumps(expected.get(key)), json.dumps(seen.get(key)))
        for key in dict.fromkeys((*expected, *seen))
    ]
    return [row for row in rows if row[1] != row[2]]


def summary(answers: Sequence[Answer]) -> str:
    """``12 as assumed, 1 differs``."""
    counted = Counter(answer.verdict for answer in answers)
    return ", ".join(f"{counted[verdict]} {verdict.value}" for verdict in Verdict if counted[verdict])


def _notes(answer: Answer) -> str:
    notes = ((name, value) for name, value in (answer.seen or {}).items() if name.startswith(NOTE))
    return ", ".join(f"{name.removeprefix(NOTE)} {json.dumps(value)}" for name, value in notes)


def _cell(text: str) -> str:
    return " ".join(text.split())[:400]
