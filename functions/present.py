"""Present: keeps a robot's findings of a run in their table, mails the serious ones, and has the robot keep
what its ring has of their times, if it has a trigger on findings.

The state machine also calls it for what failed, a drive or a robot's step, which becomes a finding too.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

from functions.shared import clients
from functions.shared.analysis import Kept, failure
from functions.shared.clients import variables
from functions.shared.metrics import emit
from functions.shared.takes import Takes
from iort_contract.catalog.analysis import KINDS, SERIOUS
from iort_contract.catalog.environments import PresentEnvironment
from iort_contract.cloud import drive_prefix, findings_key
from iort_contract.findings_table import FindingsTable
from iort_contract.messages.analysis import DriveKey, Finding, decode_finding
from iort_contract.page import history_link

Notify = Callable[[str, str], None]
# Has a robot keep the times of new findings; returns how many.
Take = Callable[[str, Sequence[Finding]], int]


def present(
    drives: Iterable[tuple[DriveKey, Sequence[Finding]]],
    table: FindingsTable,
    notify: Notify,
    page_url: str,
    take: Take = lambda _robot, _new: 0,
) -> dict[str, int]:
    """Replace the findings of each drive; mail the serious ones that are new, and ``take`` all new ones.

    A robot's findings of one kind are one mail, about the first: a run may be of a year's drives.
    """
    kept, mailed, new = 0, set[tuple[str, str]](), dict[str, list[Finding]]()
    for drive, found in drives:
        before = {one.id: one for one in table.of_drive(drive)}
        for finding in found:
            about = (drive.robot, finding.kind)
            if finding.id not in before:
                new.setdefault(drive.robot, []).append(finding)
            if finding.severity == SERIOUS and finding.id not in before and about not in mailed:
                notify(*mail(finding, page_url))
                mailed.add(about)
            # After the mail: a failure in between sends it twice, but never loses it.
            table.put_finding(finding)
            kept += 1
        for gone in before.keys() - {one.id for one in found}:
            table.remove(before[gone])
    emit("present", FindingTakes=sum(take(robot, some) for robot, some in new.items()))
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


def _notify(subject: str, text: str) -> None:
    clients.send(variables(PresentEnvironment).alarm_topic, subject, text)


def handler(event: Mapping[str, Any], _context: object) -> dict[str, int]:
    """Entry point of the states Present, and Failed with what ``failed``."""
    given = variables(PresentEnvironment)
    table = FindingsTable(clients.dynamodb(), given.findings_table)
    if "failed" in event:
        table.put_finding(failure(event["failed"], event["error"], event.get("state", "")))
        return {"findings": 1, "mails": 0}
    kept = Kept(clients.s3(), given.files_bucket)
    content = kept.json(findings_key(event["job"], event["robot"]))
    for drive in (DriveKey(**one) for one in content["gone"]):
        remove(drive, table, kept)
    drives = (
        (DriveKey(**one["drive"]), [decode_finding(finding) for finding in one["findings"]])
        for one in content["drives"]
    )
    return present(drives, table, _notify, given.page_url, Takes(clients.iot_data()).ask)
