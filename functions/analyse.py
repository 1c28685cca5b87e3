"""Analyse: one drive, as an item of the state machine's map.

Its result goes to the bucket, and a row with its estimates to the table of findings, for later drives. Run
again it writes the same.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from functions.shared import clients, recordings
from functions.shared.analysis import Kept
from functions.shared.clients import variables
from functions.shared.recordings import Recordings
from iort_analysis.archive.columns import write_table
from iort_analysis.drives.stretches import recorded
from iort_analysis.process import analyse
from iort_analysis.results import DriveResult, encode_result
from iort_analysis.samples.batches import RefusedItems
from iort_analysis.samples.blocks import Block
from iort_contract.catalog.environments import PlanEnvironment
from iort_contract.cloud import drive_prefix
from iort_contract.findings_table import FindingsTable
from iort_contract.messages.analysis import AnalysedDrive, PlannedDrive, decode_planned

# An item of the table holds 400 KB; 50 streams of 100 null fields would be more.
_MOST_REASONS, _LONGEST_REASON = 200, 300


def analysed(planned: PlannedDrive, recordings: Recordings) -> DriveResult:
    """The result of a drive, from its samples as they are stored."""
    drive, registered = planned.drive, recordings.registered(planned.drive.robot)
    streams: dict[str, Block] = {}
    notes: dict[str, str] = {}
    for stream in planned.streams:
        refused = RefusedItems()
        items = recordings.items(drive.robot, stream, drive.start_us, planned.end_us + 1, refused=refused)
        found = recorded(drive, planned.end_us, stream, items)
        streams[stream] = found.block
        notes.update(found.notes)
        if refused.count:
            notes[f"{stream} archive"] = refused.reason
    result = analyse(drive, streams, registered.vehicle, registered.known)
    mined = replace(result.mined, missing={**notes, **result.mined.missing})
    return replace(result, end_us=planned.end_us, mined=mined)


def row(result: DriveResult, job: str) -> AnalysedDrive:
    """What the table keeps of a result."""
    mined = result.mined
    return AnalysedDrive(
        drive=result.drive,
        end_us=result.end_us,
        job=job,
        samples=result.samples,
        estimates=mined.estimates,
        missing=_in_a_row(mined.missing),
        repairs=result.repairs,
        analysed_us=time.time_ns() // 1000,
    )


def _in_a_row(missing: Mapping[str, str]) -> dict[str, str]:
    """As many reasons as an item of the table holds; those about single fields are left out first."""
    names = sorted(missing, key=lambda name: "." in name)
    kept = {name: missing[name][:_LONGEST_REASON] for name in names[:_MOST_REASONS]}
    if len(names) > _MOST_REASONS:
        kept["others"] = f"{len(names) - _MOST_REASONS:,} more are in the drive's result.json"
    return kept


def handler(event: Mapping[str, Any], _context: object) -> None:
    """Entry point of the state Analyse."""
    given = variables(PlanEnvironment)
    result = analysed(decode_planned(event["planned"]), recordings.deployed())
    kept = Kept(clients.s3(), given.files_bucket)
    prefix = drive_prefix(result.drive)
    kept.put_json(f"{prefix}result.json", encode_result(result))
    for name, table in result.mined.tables.items():
        kept.put(f"{prefix}{name}.parquet", write_table(table), "application/vnd.apache.parquet")
    # The row comes last: it says that the result is there.
    FindingsTable(clients.dynamodb(), given.findings_table).put_drive(row(result, event["job"]))
