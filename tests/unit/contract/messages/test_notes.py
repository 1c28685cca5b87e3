"""Notes survive their row of the table, by time, and anything else is refused."""

from __future__ import annotations

from typing import Any

import pytest

from iort_contract.findings_table import FindingsTable
from iort_contract.limits import ContractError
from iort_contract.messages.analysis import MAX_NOTE_CHARACTERS, Note, decode_note, encode_note
from tests.unit.contract.messages.test_findings import FINDING

FIRST_US = 1_700_000_000_000_000


def note(seconds: int = 0, **given: Any) -> Note:
    told = {"robot": "car7", "text": "changed tyre", "by": "ada@lab", "salt": f"{seconds:08x}"}
    return Note(t_us=FIRST_US + seconds * 1_000_000, **{**told, **given})


class OneTable:
    """The calls of DynamoDB's client that the table of findings makes."""

    def __init__(self) -> None:
        self.items: dict[tuple[str, str], Any] = {}

    def put_item(self, *, TableName: str, Item: Any) -> None:
        self.items[Item["robot"]["S"], Item["finding"]["S"]] = Item

    def delete_item(self, *, TableName: str, Key: Any, ReturnValues: str) -> dict[str, Any]:
        found = self.items.pop((Key["robot"]["S"], Key["finding"]["S"]), None)
        return {} if found is None else {"Attributes": found}

    def query(self, **query: Any) -> dict[str, Any]:
        robot, first, last = (
            query["ExpressionAttributeValues"][f":{n}"]["S"] for n in ("robot", "first", "last")
        )
        keys = sorted(key for key in self.items if key[0] == robot and first <= key[1] <= last)
        return {"Items": [self.items[key] for key in reversed(keys)]}


def test_notes_are_rows_beside_the_findings() -> None:
    table = FindingsTable(OneTable(), "findings")
    table.put_finding(FINDING)
    for seconds in (0, 60, 120):
        table.put_note(note(seconds))
    table.put_note(note(text="another car", robot="car8"))
    assert [one.id for one in table.notes("car7")] == [note(s).id for s in (120, 60, 0)]
    # From a time, inclusive, to a time, exclusive.
    assert list(table.notes("car7", FIRST_US, FIRST_US + 120_000_000, most=1)) == [note(60)]
    assert list(table.findings("car7")) == [FINDING]
    assert list(table.drives("car7")) == []
    assert table.remove_note("car7", note(60).id)
    assert not table.remove_note("car7", note(60).id)
    assert list(table.notes("car7")) == [note(120), note(0)]


@pytest.mark.parametrize(
    "change",
    [
        {"text": " "},
        {"text": "x" * (MAX_NOTE_CHARACTERS + 1)},
        {"by": "x" * 65},
        {"t_us": -1},
        {"t_us": 10**16},
        {"salt": "XYZ"},
        {"robot": "car 7"},
    ],
)
def test_what_is_no_note_is_refused(change: dict[str, Any]) -> None:
    with pytest.raises(ContractError):
        decode_note({**encode_note(note()), **change})
    with pytest.raises(ContractError):
        encode_note(decode_note({**vars(note()), **change}))
