"""Present: keeps the findings of a run in their table, and mails the serious ones.

The state machine also calls it for a drive that could not be analysed, which becomes a finding too.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from typing import Any

from functions.shared import clients
from functions.shared.analysis.kept import Kept
from functions.shared.environment import variables
from iort_contract.catalog.analysis.kinds import ANALYSIS_FAILED, KINDS, SERIOUS
from iort_contract.catalog.environments import PresentEnvironment
from iort_contract.cloud import drive_prefix, findings_key
from iort_contract.findings_table import FindingsTable
from iort_contract.messages.analysis.findings import NO_RUN, DriveKey, Finding, decode_finding
from iort_contract.page import history_link

Notify = Callable[[str, str], None]
_MOST_REASON = 500


def present(
    drives: Iterable[tuple[DriveKey, Sequence[Finding]]], table: FindingsTable, notify: Notify, page_url: str
) -> dict[str, int]:
    """Replace the findings of each drive; mail the serious ones that are new.

    A robot's findings of one kind are one mail, about the first: a run may be of a year's drives.
    """
    kept, mailed = 0, set[tuple[str, str]]()
    for drive, found in drives:
        before = {one.id: one for one in table.of_drive(drive)}
        for finding in found:
            about = (drive.robot, finding.kind)
            if finding.severity == SERIOUS and finding.id not in before and about not in mailed:
                notify(*mail(finding, page_url))
                mailed.add(about)
            # After the mail: a failure in between sends it twice, but never loses it.
            table.put_finding(finding)
            kept += 1
        for gone in before.keys() - {one.id for one in found}:
            table.remove(before[gone])
    return {"findings": kept, "mails": len(mailed)}


def remove(drive: DriveKey, table: FindingsTable, kept: Kept) -> None:
    """Remove a drive that others stand for now; its row comes last, because it tells of the rest."""
    for finding in table.of_drive(drive):
        table.remove(finding)
    kept.remove(drive_prefix(drive))
    table.remove_drive(drive)


def mail(finding: Finding, page_url: str) -> tuple[str, str]:
    """The subject and the text of a mail about a finding."""
    kind, drive = KINDS[finding.kind], finding.drive
    lines = [f"{drive.robot}: {finding.text}", ""]
    for label, estimate in (("effect", finding.effect), ("before", finding.baseline)):
        if estimate is not None:
            low, high, unit = estimate.low, estimate.high, "" if estimate.unit == "1" else f" {estimate.unit}"
            lines.append(f"{label:9}{estimate.value:.4g}{unit}, 90 % sure between {low:.4g} and {high:.4g}")
    if finding.q is not None:
        lines.append(f"{'chance':9}at most {finding.q:.2g} of such findings are false")
    lines += [
        f"{'evidence':9}{history_link(page_url, finding)}",
        f"{'to do':9}{kind.action}",
        "",
        f"All findings: iort findings {drive.robot}",
    ]
    return f"{drive.robot}: {kind.meaning}", "\n".join(lines) + "\n"


def failure(event: Mapping[str, Any]) -> Finding:
    """The finding about a drive that could not be analysed, or a robot whose drives could not be found."""
    about = event["failed"]
    drive = DriveKey(about["robot"], about["start_us"], about.get("run", NO_RUN))
    what = "the drive could not be analysed" if "run" in about else "the drives could not be found"
    return Finding(
        drive=drive,
        kind=ANALYSIS_FAILED,
        severity=KINDS[ANALYSIS_FAILED].severity,
        subject=ANALYSIS_FAILED,
        from_us=about["start_us"],
        to_us=about["end_us"],
        stream=about.get("motion", ""),
        fields=(),
        text=f"{what} in three attempts: {reason(event['error'])}",
    )


def reason(error: Mapping[str, str]) -> str:
    """What a failed state says: the function's own error, if it had time for one."""
    cause = error.get("Cause", "")
    with suppress(ValueError, TypeError, KeyError):
        failed = json.loads(cause)
        cause = f"{failed['errorType']}: {failed['errorMessage']}"
    return f"{cause or error.get('Error', 'unknown')}"[:_MOST_REASON]


def _notify(subject: str, text: str) -> None:
    # "Publish", SNS API: a subject is up to 100 ASCII characters.
    topic = variables(PresentEnvironment).alarm_topic
    clients.sns().publish(TopicArn=topic, Subject=subject[:100], Message=text)


def handler(event: Mapping[str, Any], _context: object) -> dict[str, int]:
    """Entry point of the states Present, and Failed with what ``failed``."""
    given = variables(PresentEnvironment)
    table = FindingsTable(clients.dynamodb(), given.findings_table)
    if "failed" in event:
        found = failure(event)
        table.put_finding(found)
        return {"findings": 1, "mails": 0}
    kept = Kept(clients.s3(), given.files_bucket)
    content = kept.json(findings_key(event["job"]))
    for drive in (DriveKey(**one) for one in content["gone"]):
        remove(drive, table, kept)
    drives = (
        (DriveKey(**one["drive"]), [decode_finding(finding) for finding in one["findings"]])
        for one in content["drives"]
    )
    return present(drives, table, _notify, given.page_url)
