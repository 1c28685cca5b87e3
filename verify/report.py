"""The report of a run, as JSON and as Markdown, without account numbers and secrets.

`make verify-aws KEEP=1` keeps AWS' answers in the repository: tests compare the embedded cloud with them, and
docs/explanation/assumptions.md names who measured them and when.
`python -m verify.report` writes the table of the questions into that page.
"""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from local.deployment import ROOT
from testkit.command import Table
from testkit.waiting import InstrumentError
from verify.question import NOTE, Answer, Question, Verdict, compared
from verify.questions import ALL

KEPT = Path(__file__).resolve().parent / "aws.json"
PAGE = ROOT / "docs" / "explanation" / "assumptions.md"
BY_HAND = "## Not asked\n"
_HEAD = ["behaviour", "what we rely on", "basis", "embedded cloud"]
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
        seen = {answer["name"]: answer["seen"] for answer in report["answers"] if answer["seen"] is not None}
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
    entries = [
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
    # A time with twelve digits or more is not an account; by `Question`, answers hold no times.
    text = json.dumps({**asdict(run), "answers": entries}, indent=1) + "\n"
    (folder / "report.json").write_text(redacted(text))
    (folder / "report.md").write_text(redacted(_as_markdown(run, answers)))


def _as_markdown(run: Run, answers: Sequence[Answer]) -> str:
    """The report for people: the verdicts first, then all answers that differ."""
    rows = [
        [answer.question.name, answer.verdict.value, f"{answer.took_s:.1f} s", _cell(_note(answer))]
        for answer in answers
    ]
    asked = f"{run.date}, {run.region}, {run.version}, asked by {run.by or 'nobody named'}"
    parts = [
        f"# What {run.target} answered\n",
        f"{asked}: {summary(answers)}.\n",
        *(f"- preflight: {finding}" for finding in run.preflight),
        *(f"- left over: {name}" for name in run.left_over),
        "",
        Table("", ["question", "verdict", "took", "note"], rows).as_markdown(),
    ]
    for answer in answers:
        if answer.verdict is Verdict.DIFFERS:
            differing = [[_cell(cell) for cell in row] for row in differences(answer)]
            parts += ["", f"## {answer.question.name}", "", answer.question.assumed, ""]
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


def _note(answer: Answer) -> str:
    notes = ((name, value) for name, value in (answer.seen or {}).items() if name.startswith(NOTE))
    return answer.reason or ", ".join(
        f"{name.removeprefix(NOTE)} {json.dumps(value)}" for name, value in notes
    )


def _cell(text: str) -> str:
    return " ".join(text.split())[:400]


def main() -> None:
    """Write the page."""
    PAGE.write_text(text(load(), PAGE.read_text()))


def text(known: Measured, page: str) -> str:
    """The whole page, with the parts of ``page`` that are written by hand: before the count, and the end."""
    introduction, _, _ = page.partition("`make verify-aws` asks ")
    _, heading, by_hand = page.partition(BY_HAND)
    count, total = sum(one.name in known.seen for one in ALL), len(ALL) + len(rows(by_hand))
    who = f" by {known.by} on {known.date} in {known.region}" if known.seen else ""
    counted = f"`make verify-aws` asks {len(ALL)} of {total} behaviours. {count} were measured{who}."
    cells = [[f"`{one.name}`", one.assumed, _basis(one, known), _embedded(one)] for one in ALL]
    asked = ["## Asked by `make verify-aws`", "", Table("", _HEAD, cells).as_markdown()]
    return "\n".join([f"{introduction}{counted}", "", *asked, "", heading + by_hand])


def rows(by_hand: str) -> list[list[str]]:
    """The cells of each row of a page's table."""
    lines = [line for line in by_hand.splitlines() if line.startswith("| `")]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]


def _basis(one: Question, known: Measured) -> str:
    if one.name in known.seen:
        same = compared(known.seen[one.name]) == one.expected
        return f"measured ({'as assumed' if same else 'differs'})"
    return f"documented: {one.source}" if one.source else "assumed"


def _embedded(one: Question) -> str:
    return f"not asked: {one.not_embedded}" if one.not_embedded else "asked in every test run"


if __name__ == "__main__":
    main()
