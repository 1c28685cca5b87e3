"""A move replaces nothing that the target has of its own, nothing that was deleted comes back, and both sides
are not one account.
"""

from __future__ import annotations

import hashlib
import io
import time
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest
from botocore.exceptions import ClientError

from iort_analysis.archive.hours import HourFile
from iort_analysis.archive.writing import described, write_day
from iort_contract.archive import ArchivedHour, archived_hour, parse_hour
from iort_contract.dynamodb import TableError
from iort_contract.findings_table import FindingsTable
from iort_contract.messages.analysis import AnalysedDrive, Finding
from iort_contract.topics import RECORD, build_topic
from iort_station.cloud import Cloud
from iort_station.data import recorded
from iort_station.errors import StationError
from iort_station.migration import plan, recordings, robots
from tests.unit.analysis.test_archive import batch_at, item_of
from tests.unit.analysis.test_archive import written as written_hour
from tests.unit.contract.test_messages import FINDING, OneTable, note

TOPIC = build_topic(RECORD, "car7", "vesc")
DAY = "archive/robot=car7/stream=vesc/date=2026-11-22/day.parquet"


def day(*hours: str) -> bytes:
    """A day's object; each batch tells its hour."""
    files = {}
    for name in hours:
        hour = parse_hour(f"2026-11-22T{name}")
        files[hour] = written_hour([item_of(batch_at(hour, 0, {"speed": [float(name)] * 3}))], hour)[0]
    into = io.BytesIO()
    write_day(files, into, describe=described("vesc"))
    return into.getvalue()


class Account:
    """The calls of a cloud that a move makes."""

    endpoint_url, region_name = None, "eu-west-1"

    def __init__(self, number: str, *hours: str) -> None:
        self.number = number
        self.content = {DAY: day(*hours)} if hours else {}
        sha256 = hashlib.sha256(self.content.get(DAY, b"")).hexdigest()
        self.rows = [
            ArchivedHour(TOPIC, f"2026-11-22T{hour}", DAY, 1, 50, 0, "", sha256, 1, 0, 0) for hour in hours
        ]
        # The row that its archive writes before the next one is put.
        self.meanwhile: list[ArchivedHour] = []
        self.findings = FindingsTable(OneTable(), "findings")

    def client(self, _service: str) -> Account:
        return self

    def output(self, *_: str) -> str:
        return "name"

    def get_caller_identity(self) -> dict[str, str]:
        return {"Account": self.number}

    def get_object(self, *, Bucket: str, Key: str) -> dict[str, Any]:
        return {"Body": io.BytesIO(self.content[Key])}

    def put_object(self, *, Bucket: str, Key: str, Body: bytes, IfNoneMatch: str = "") -> None:
        if IfNoneMatch and Key in self.content:
            raise ClientError({"Error": {"Code": "PreconditionFailed"}}, "PutObject")
        self.content[Key] = Body

    def put_item(self, *, TableName: str, Item: dict[str, Any], ConditionExpression: str) -> None:
        if self.meanwhile:
            self.rows.append(self.meanwhile.pop())
        if Item["hour"]["S"] in {row.hour for row in self.rows}:
            raise ClientError({"Error": {"Code": "ConditionalCheckFailedException"}}, ConditionExpression)
        self.rows.append(archived_hour(Item))


@pytest.fixture(autouse=True)
def accounts(monkeypatch: pytest.MonkeyPatch) -> None:
    class Rows:
        def __init__(self, account: Account, _topic: str) -> None:
            self.rows = account.rows.copy

    monkeypatch.setattr(recordings, "archive_of", Rows)
    monkeypatch.setattr(robots.findings, "findings_table", lambda account: account.findings)


def test_two_profiles_of_one_account_are_one_deployment(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Cloud, "client", lambda cloud, _service: Account("1" if cloud.profile else "2"))
    monkeypatch.setattr(Cloud, "region_name", property(lambda cloud: cloud.region))
    monkeypatch.setattr(Cloud, "output", lambda *_: "name")
    here, lab, other = (Cloud(profile=profile, region="eu-west-1") for profile in ("a", "b", None))
    with pytest.raises(StationError, match="the source itself"):
        plan.check(here, lab)
    plan.check(here, other)
    plan.check(here, replace(lab, region="us-east-1"))


def test_what_the_target_has_archived_is_not_replaced() -> None:
    source = Account("1", "07", "08")
    new = Account("2")
    assert [recordings.copy_hours(source, new, TOPIC) for _ in range(2)] == [2, 0]
    assert (new.content, new.rows) == (source.content, source.rows)
    # Killed before the row was written.
    new.rows.pop()
    assert recordings.copy_hours(source, new, TOPIC) == 1
    # A day of its own, with and without the rows that point to it; and a row that comes between.
    for other in (Account("2", "08", "09"), Account("2")):
        other.content[DAY], rows = day("08", "09"), list(other.rows)
        assert recordings.copy_hours(source, other, TOPIC) == 0
        assert (other.content[DAY], other.rows) == (day("08", "09"), rows)
    late = Account("2")
    late.meanwhile = [replace(source.rows[0], content="own")]
    assert recordings.copy_hours(source, late, TOPIC) == 1


def test_an_hour_that_both_have_is_merged_from_the_sources_archive(monkeypatch: pytest.MonkeyPatch) -> None:
    hour = parse_hour("2026-11-22T07")
    items = [item_of(batch_at(hour, minute, {"speed": [float(minute)] * 3})) for minute in range(3)]
    row = ArchivedHour(TOPIC, str(hour), DAY, 2, 6, 0, "source", "", 1, 0, 0)
    rows = {"source": [row], "target": [replace(row, content="target")]}
    has = {"source": items[:2], "target": items[1:]}
    table = []

    class Hours:
        def __init__(self, side: str, _topic: str) -> None:
            self._side = side

        def rows(self) -> list[ArchivedHour]:
            return rows[self._side]

        def read(self, _row: ArchivedHour, use: Any) -> list[Any]:
            return (
                has[self._side] if use is HourFile.items else [one["batch"]["S"] for one in has[self._side]]
            )

    class Table:
        def pages(self, *_keys: Any, attributes: Any) -> list[Any]:
            return [SimpleNamespace(items=table)]

        def put(self, new: list[Any]) -> None:
            table.extend(new)

    monkeypatch.setattr(recordings, "archive_of", Hours)
    monkeypatch.setattr(recordings, "telemetry_table", lambda _side: Table())
    sides: Any = "source", "target"
    assert [recordings.merge_hours(*sides, TOPIC) for _ in range(2)] == [1, 0]
    (copied,) = table
    expires_s = int(copied.pop("expires_s")["N"])
    assert copied == {name: value for name, value in items[0].items() if name != "expires_s"}
    assert expires_s > time.time() + 29 * 86_400
    table.clear()
    # The target has this day in another object, without this hour.
    rows["target"].clear()
    assert recordings.merge_hours(*sides, TOPIC) == 2
    rows["target"] = [replace(row, content="target")]
    table.clear()
    # The source's table has all of it, which is copied from there; or the hours are the same.
    for same in ({"first_expires_s": int(time.time()) + 10 * 86_400}, {"content": "target"}):
        rows["source"] = [replace(row, **same)]
        assert recordings.merge_hours(*sides, TOPIC) == 0


def test_what_the_target_has_analysed_again_is_not_replaced() -> None:
    source, target = Account("1"), Account("2")
    finding: Finding = FINDING
    robot = finding.drive.robot
    source.findings.put_finding(finding)
    # A drive whose analysis failed has no row.
    assert [robots.copy_findings(source, target, robot) for _ in range(2)] == [1, 0]
    source.findings.put_drive(AnalysedDrive(finding.drive, finding.drive.start_us + 1, "old", 1, {}, {}, {}))
    source.findings.put_note(note(robot=robot))
    assert [robots.copy_findings(source, target, robot) for _ in range(2)] == [2, 0]
    again = AnalysedDrive(finding.drive, finding.drive.start_us + 1, "again", 1, {}, {}, {})
    target.findings.put_drive(again)
    target.findings.remove(finding)
    assert robots.copy_findings(source, target, robot) == 0
    assert (list(target.findings.drives(robot)), list(target.findings.findings(robot))) == ([again], [])


def test_a_note_that_was_deleted_on_either_side_does_not_come_back() -> None:
    source, target = Account("1"), Account("2")
    notes = [note(seconds) for seconds in (0, 60, 120)]
    for one in notes:
        source.findings.put_note(one)
    assert robots.copy_findings(source, target, "car7") == 3
    assert source.findings.remove_note("car7", notes[0].id)
    assert target.findings.remove_note("car7", notes[1].id)
    assert robots.copy_findings(source, target, "car7") == 0
    assert list(target.findings.notes("car7")) == [notes[2]]
    assert list(source.findings.notes("car7")) == [notes[2], notes[1]]


class Full:
    """A table that takes nothing, or everything."""

    def __init__(self, error: Exception | None = None) -> None:
        self.error, self.calls = error, []

    def put(self, items: list[Any]) -> None:
        self.calls.append(len(items))
        if self.error:
            raise self.error


def test_the_write_rate_is_limited(monkeypatch: pytest.MonkeyPatch) -> None:
    """A topic is one partition, and the robot writes to it at the same time."""
    slept: list[float] = []
    monkeypatch.setattr(time, "sleep", slept.append)
    table: Any = Full()
    recorded.write(table, [{"samples": "x" * 100}] * 100, 5)
    # A small batch is one unit, and 25 are written at once.
    assert table.calls == [25] * 4
    assert sum(slept) == pytest.approx(100 / 5, abs=1)


def test_items_that_stay_unprocessed_are_an_error_with_advice() -> None:
    table: Any = Full(TableError("1 items of telemetry not written"))
    with pytest.raises(StationError, match=r"1 items of telemetry not written; do it again"):
        recorded.write(table, [{"samples": "x"}], 5)
