"""Moves what the analysis and people have written about robots: findings, analysed drives and notes."""

from __future__ import annotations

from iort_station.cloud import Cloud
from iort_station.data import findings


def copy(source: Cloud, target: Cloud, robot: str) -> int:
    """Copy the findings, analysed drives and notes of a robot that the target lacks; returns how many.

    A note that was deleted on either side is deleted in the target.
    """
    old, new = findings.findings_table(source), findings.findings_table(target)
    # The target may have analysed a drive again, with all of its batches.
    analysed, there = {one.drive for one in new.drives(robot)}, {note.id for note in new.notes(robot)}
    # A drive whose analysis failed has a finding, and no row.
    found = {finding.id for finding in new.findings(robot)}
    count = 0
    for finding in old.findings(robot):
        if finding.drive not in analysed and finding.id not in found:
            new.put_finding(finding)
            count += 1
    # After its findings: a move that ends between them goes on.
    for drive in old.drives(robot):
        if drive.drive not in analysed:
            new.put_drive(drive)
            count += 1
    removed = old.removed_notes(robot)
    for note_id in removed & there:
        new.remove_note(robot, note_id)
    removed |= new.removed_notes(robot)
    for note in old.notes(robot):
        if note.id not in there | removed:
            new.put_note(note)
            count += 1
    return count
