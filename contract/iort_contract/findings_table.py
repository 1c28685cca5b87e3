"""The table of findings in DynamoDB: findings, a row of each analysed drive, and notes, by robot and time.

The content of a row is JSON, so that numbers come back as they were.
"""

from __future__ import annotations

import json
from contextlib import suppress
from itertools import islice
from typing import Any, Callable, Iterable, Iterator, Mapping, TypeVar

from iort_contract.checks import json_object
from iort_contract.dynamodb import Item, Keys, TopicTable
from iort_contract.limits import ContractError
from iort_contract.messages.analysis import (
    AnalysedDrive,
    DriveKey,
    Finding,
    Note,
    decode_analysed,
    decode_finding,
    decode_note,
    encode_analysed,
    encode_finding,
    encode_note,
)
from iort_contract.tables import CONTENT, FINDING, NOTE_PREFIX, PARAMETERS_PREFIX, REMOVED_PREFIX, ROBOT

T = TypeVar("T")


class FindingsTable:
    """Reads and writes the table; ``client`` is a boto3 DynamoDB client or a fake of it."""

    def __init__(self, client: Any, name: str) -> None:
        self._client, self._name = client, name
        self._rows = TopicTable(client, name, FINDING, ROBOT)

    def findings(
        self, robot: str, start_us: int | None = None, end_us: int | None = None
    ) -> Iterator[Finding]:
        """A robot's findings about drives that begin in a range, the newest first."""
        return self._newest(decode_finding, robot, "", (start_us, end_us))

    def of_drive(self, drive: DriveKey) -> list[Finding]:
        return list(_decoded(decode_finding, self._between(drive.robot, f"{drive}-", f"{drive}-~")))

    def drives(
        self, robot: str, start_us: int | None = None, end_us: int | None = None, *, most: int | None = None
    ) -> Iterator[AnalysedDrive]:
        """A robot's analysed drives that begin in a range, the newest first; at most so many."""
        return self._newest(decode_analysed, robot, PARAMETERS_PREFIX, (start_us, end_us), most)

    def notes(
        self, robot: str, start_us: int | None = None, end_us: int | None = None, *, most: int | None = None
    ) -> Iterator[Note]:
        """A robot's notes about a range, the newest first; at most so many."""
        return self._newest(decode_note, robot, NOTE_PREFIX, (start_us, end_us), most)

    def put_finding(self, finding: Finding) -> None:
        """Write a finding; one of the same id is replaced."""
        self._put(finding.drive.robot, finding.id, encode_finding(finding))

    def put_drive(self, analysed: AnalysedDrive) -> None:
        """Write the row of an analysed drive; an earlier one of the drive is replaced."""
        key = f"{PARAMETERS_PREFIX}{analysed.drive}"
        self._put(analysed.drive.robot, key, encode_analysed(analysed))

    def put_note(self, note: Note) -> None:
        self._put(note.robot, f"{NOTE_PREFIX}{note.id}", encode_note(note))

    def remove(self, finding: Finding) -> None:
        """Remove a finding that a later analysis of its drive no longer has."""
        self._delete(finding.drive.robot, finding.id)

    def remove_drive(self, drive: DriveKey) -> None:
        self._delete(drive.robot, f"{PARAMETERS_PREFIX}{drive}")

    def remove_note(self, robot: str, note_id: str) -> bool:
        """Remove a note, and keep its id; False if there is none of this id."""
        key = f"{NOTE_PREFIX}{note_id}"
        if next(self._between(robot, key, key), None) is None:
            return False
        # Before the note goes: a call that ends between them can be repeated.
        self._put(robot, f"{REMOVED_PREFIX}{note_id}", {})
        return self._delete(robot, key)

    def removed_notes(self, robot: str) -> set[str]:
        """The ids of a robot's notes that were removed."""
        rows = self._between(robot, REMOVED_PREFIX, f"{REMOVED_PREFIX}~")
        return {str(row[FINDING]["S"])[len(REMOVED_PREFIX) :] for row in rows}

    def _delete(self, robot: str, key: str) -> bool:
        answer = self._client.delete_item(
            TableName=self._name, Key={ROBOT: {"S": robot}, FINDING: {"S": key}}, ReturnValues="ALL_OLD"
        )
        return "Attributes" in answer

    def _newest(
        self,
        decode: Callable[[Mapping[str, Any]], T],
        robot: str,
        prefix: str,
        times_us: tuple[int | None, int | None],
        most: int | None = None,
    ) -> Iterator[T]:
        """The contents of a prefix's rows in a range, the newest first; at most so many."""
        start_us, end_us = times_us
        first = f"{prefix}0" if start_us is None else f"{prefix}{start_us:016d}"
        last = f"{prefix}9~" if end_us is None else f"{prefix}{end_us - 1:016d}~"
        rows = self._between(robot, first, last, newest_first=True, page_items=most)
        return islice(_decoded(decode, rows), most)

    def _put(self, robot: str, key: str, content: Mapping[str, Any]) -> None:
        text = json.dumps(content, separators=(",", ":"), allow_nan=False)
        item = {ROBOT: {"S": robot}, FINDING: {"S": key}, CONTENT: {"S": text}}
        self._client.put_item(TableName=self._name, Item=item)

    def _between(self, robot: str, first: str, last: str, **pages: Any) -> Iterator[Item]:
        keys = Keys({"S": first}, {"S": last}, first > last)
        return (item for page in self._rows.pages(robot, keys, **pages) for item in page.items)


def _decoded(decode: Callable[[Mapping[str, Any]], T], rows: Iterable[Mapping[str, Any]]) -> Iterator[T]:
    """The rows' contents; another version's rows are left out."""
    for row in rows:
        with suppress(ContractError):
            yield decode(json_object(row[CONTENT]["S"], "a row of the findings"))
