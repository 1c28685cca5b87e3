"""The report of a run, as JSON and as Markdown, without account numbers and secrets.

`make verify-aws KEEP=1` keeps AWS' answers in the repository: tests compare the embedded cloud with them, and
docs/explanation/assumptions.md names who measured them and when.
`python -m verify.report` writes the table of the questions into that page.
"""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from math import ceil
from pathlib import Path
from typing import Any

from iort_station.cost.prices import MONTH_HOURS, PRICES
from local.deployment import ROOT
from testkit.command import Table
from testkit.waiting import InstrumentError
from verify.question import NOTE, Answer, Question, Verdict, compared
from verify.questions import ALL

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


PAGE = ROOT / "docs" / "explanation" / "assumptions.md"
BY_HAND = "## Not asked\n"
_HEAD = ["behaviour", "what we rely on", "basis", "relied on by", "embedded cloud"]
_INTRODUCTION = """\
# The design's assumptions about AWS

Each row is a behaviour of AWS that the code relies on and that the embedded cloud imitates. *Documented*
names AWS' page. *Assumed* means that AWS does not document it. *Measured* means that `make verify-aws` has
seen it in an account; tests/local/emulator/test_verify.py then expects the same answer from the embedded
cloud.
How to ask your own account: [deploy](../how-to/deploy.md#ask-your-account). `python -m verify.report`
writes the first table from verify/questions/; the second is written by hand.
"""


def main() -> None:
    """Write the page."""
    PAGE.write_text(text(load(), PAGE.read_text()))


def text(known: Measured, page: str) -> str:
    """The whole page, with the part of ``page`` that is written by hand."""
    _, heading, by_hand = page.partition(BY_HAND)
    return "\n".join((*_generated(known, len(rows(by_hand))), "", heading + by_hand))


def rows(by_hand: str) -> list[list[str]]:
    """The cells of each row of a page's table."""
    lines = [line for line in by_hand.splitlines() if line.startswith("| `")]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]


def _generated(known: Measured, not_asked: int) -> Iterator[str]:
    yield _INTRODUCTION
    count = sum(one.name in known.seen for one in ALL)
    yield (
        f"`make verify-aws` asks {len(ALL)} of {len(ALL) + not_asked} behaviours. {count} were "
        f"measured{f' by {known.by} on {known.date} in {known.region}' if known.seen else ''}."
    )
    yield ""
    yield "## Asked by `make verify-aws`"
    yield ""
    cells = [
        [f"`{one.name}`", one.assumed, _basis(one, known), ", ".join(one.relied_on_by), _embedded(one)]
        for one in ALL
    ]
    yield Table("", _HEAD, cells).as_markdown()


def _basis(one: Question, known: Measured) -> str:
    if one.name in known.seen:
        same = compared(known.seen[one.name]) == one.expected
        return f"measured ({'as assumed' if same else 'differs'})"
    return f"documented: {one.source}" if one.source else "assumed"


def _embedded(one: Question) -> str:
    return f"not asked: {one.not_embedded}" if one.not_embedded else "asked in every test run"


if __name__ == "__main__":
    main()


# A run takes about an hour (nobody has measured it); what is metered by the hour is counted for two.
_HOURS = 2.0
# More than all questions together send and invoke (tests/local/emulator/test_verify.py counts them).
MESSAGES, INVOCATIONS, WRITES = 5_000, 2_000, 5_000
_ALARMS, _METRICS, _DASHBOARDS = 40, 200, 3
_GB_SECONDS = INVOCATIONS * 0.5 * 1.0
# What single questions use beside that, by the meters of the price list.
BESIDE: Mapping[str, Mapping[str, float]] = {
    "analysis.no_robot": {"transition": 20, "compute_arm": 10},
    "analysis.empty_plan": {"transition": 20, "compute_arm": 10},
    "analysis.one_drive": {"transition": 30, "compute_arm": 60, "express_request": 1},
    "analysis.failing_drive": {
        "transition": 60,
        "compute_arm": 120,
        "express_request": 2,
        "express_duration": 10,
    },
    "analysis.stopped": {"transition": 60, "compute_arm": 120, "express_request": 2, "express_duration": 10},
    "archive.hour_twice": {"compute_arm": 60, "queue_request": 100},
    "archive.late_batch": {"compute_arm": 60, "queue_request": 100},
    "archive.read_back": {"compute_arm": 40, "queue_request": 100},
    "archive.pyarrow_arm64": {"compute_arm": 40, "queue_request": 100},
    "schedules.archive": {"schedule": 1, "compute_arm": 10},
    # A night of the robots that the questions before have registered.
    "schedules.analysis": {"schedule": 1, "transition": 200, "compute_arm": 300},
    "stream.put_off": {"compute_arm": 200, "queue_request": 1_000},
    "functions.ten_at_once": {"compute_arm": 60, "invocation": 100},
}


def estimate() -> dict[str, float]:
    """Dollars by meter."""
    month = _HOURS / MONTH_HOURS
    each = {name: price.each for name, price in PRICES.items()}
    return {
        "messages, rules and actions": MESSAGES * (each["message"] + each["rule"] + 2 * each["action"]),
        "Lambda": INVOCATIONS * each["invocation"] + _GB_SECONDS * each["compute_arm"],
        "DynamoDB": WRITES * (each["write"] + each["read"]),
        "alarms and metrics of an hour": month * (_ALARMS * each["alarm"] + _METRICS * each["metric"]),
        "dashboards of an hour": month * _DASHBOARDS * each["dashboard"],
        "single questions": sum(
            units * each[meter] for used in BESIDE.values() for meter, units in used.items()
        ),
        "a key of one's own": month * each["key"] + 1_000 * each["key_request"],
    }


def told(dollars: dict[str, float]) -> str:
    """The estimate in one line, rounded up to a cent."""
    parts = ", ".join(f"{name} {usd:.3f}" for name, usd in dollars.items())
    return f"about ${ceil(sum(dollars.values()) * 100) / 100:.2f} ({parts})"
