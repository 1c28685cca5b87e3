"""Notes are written for the page and the terminal alike, and a wrong one writes nothing."""

from __future__ import annotations

import pytest

from iort_contract.findings_table import FindingsTable
from iort_station.data import findings as stored
from iort_station.errors import StationError, UsageError
from iort_station.page import insights
from tests.unit.contract.messages.test_notes import FIRST_US, OneTable


@pytest.fixture
def table(monkeypatch):
    made = OneTable()
    monkeypatch.setattr(stored, "findings_table", lambda _cloud: FindingsTable(made, "findings"))
    monkeypatch.setattr(stored.registry, "get", lambda _cloud, _robot: {})
    return made


def test_the_page_writes_lists_and_deletes_notes(table):
    for at in (0, 60):
        asked = {"robot": "car7", "text": f" after {at} s ", "t_us": str(FIRST_US + at * 1_000_000)}
        told = insights.write_note(None, asked)["notes"]
    assert [(one["t_us"] - FIRST_US, one["text"]) for one in told] == [
        (60_000_000, "after 60 s"),
        (0, "after 0 s"),
    ]
    part = {"robot": "car7", "from_us": str(FIRST_US), "to_us": str(FIRST_US + 1)}
    assert [one["text"] for one in insights.notes(None, part)["notes"]] == ["after 0 s"]
    assert insights.remove_note(None, {"robot": "car7", "id": told[0]["id"]})["notes"] == told[1:]


def test_a_wrong_note_is_refused_and_nothing_is_written(table):
    with pytest.raises(UsageError, match="1 to 500 characters, got 501; nothing is written"):
        stored.write_note(None, "car7", "x" * 501, by="ada")
    with pytest.raises(UsageError, match="must be the id of a note"):
        stored.remove_note(None, "car7", "parameters#1")
    with pytest.raises(StationError, match="has no note"):
        stored.remove_note(None, "car7", f"{FIRST_US}-00000000")
    assert table.items == {}
