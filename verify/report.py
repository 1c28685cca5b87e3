"""The report of a run, as JSON and as Markdown, without account numbers and secrets."""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from verify.check import NOTE, Answer, Verdict, compared

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
    """The asker, the cloud and the time; ``findings`` are the preflight's lines."""

    target: str
    region: str
    by: str
    date: str
    version: str
    findings: Sequence[str] = ()
    leftovers: Sequence[str] = ()


def redacted(text: str) -> str:
    """The text without account numbers and credentials."""
    for pattern, instead in _SECRETS:
        text = pattern.sub(instead, text)
    return text


def write(folder: Path, run: Run, answers: Sequence[Answer]) -> None:
    """Write ``report.json`` and ``report.md`` into the folder."""
    folder.mkdir(parents=True, exist_ok=True)
    # A time with twelve digits or more is not an account; by `Check`, answers hold no times.
    (folder / "report.json").write_text(redacted(as_json(run, answers)))
    (folder / "report.md").write_text(redacted(as_markdown(run, answers)))


def as_json(run: Run, answers: Sequence[Answer]) -> str:
    """The form that `verify.measured` reads."""
    report: dict[str, Any] = {
        "target": run.target,
        "region": run.region,
        "by": run.by,
        "date": run.date,
        "version": run.version,
        "preflight": list(run.findings),
        "left_over": list(run.leftovers),
        "answers": [
            {
                "name": answer.check.name,
                "verdict": answer.verdict.value,
                "assumed": answer.check.assumed,
                "expected": answer.check.expected,
                "seen": answer.seen,
                "reason": answer.reason,
                "took_s": round(answer.took_s, 1),
            }
            for answer in answers
        ],
    }
    return json.dumps(report, indent=1) + "\n"


def as_markdown(run: Run, answers: Sequence[Answer]) -> str:
    """The report for people: the verdicts first, then all answers that differ."""
    lines = [
        f"# What {run.target} answered",
        "",
        f"{run.date}, {run.region}, {run.version}, asked by {run.by or 'nobody named'}: {summary(answers)}.",
        "",
    ]
    lines += [f"- preflight: {finding}" for finding in run.findings]
    lines += [f"- left over: {name}" for name in run.leftovers]
    lines += ["", "| question | verdict | took | note |", "|---|---|---|---|"]
    for one in answers:
        row = (one.check.name, one.verdict.value, f"{one.took_s:.1f} s", _cell(one.reason or _notes(one)))
        lines.append(f"| {' | '.join(row)} |")
    for one in answers:
        if one.verdict is Verdict.DIFFERS:
            lines += ["", f"## {one.check.name}", "", one.check.assumed, ""]
            lines += ["| key | expected | seen |", "|---|---|---|"]
            lines += [f"| {key} | {want} | {got} |" for key, want, got in differences(one)]
    return "\n".join(lines) + "\n"


def differences(answer: Answer) -> list[tuple[str, str, str]]:
    """Each key of an answer that is not as expected: its name, the expected and the seen value."""
    expected, seen = compared(answer.expected or {}), compared(answer.seen or {})
    keys = [*expected, *(key for key in seen if key not in expected)]
    rows = [(key, json.dumps(expected.get(key)), json.dumps(seen.get(key))) for key in keys]
    return [(key, _cell(want), _cell(got)) for key, want, got in rows if want != got]


def summary(answers: Sequence[Answer]) -> str:
    """``12 as assumed, 1 differs``."""
    counted = Counter(answer.verdict for answer in answers)
    return ", ".join(f"{counted[verdict]} {verdict.value}" for verdict in Verdict if counted[verdict])


def _notes(answer: Answer) -> str:
    seen = answer.seen or {}
    return ", ".join(
        f"{name.removeprefix(NOTE)} {json.dumps(seen[name])}" for name in seen if name.startswith(NOTE)
    )


def _cell(text: str) -> str:
    return re.sub(r"\s+", " ", text).replace("|", "\\|")[:400]
