"""A move replaces nothing that the target has of its own, and finds that both sides are one account."""

from __future__ import annotations

import hashlib
import io
from dataclasses import replace
from typing import Any

import pytest

from iort_contract.archive import ArchivedHour
from iort_contract.findings_table import FindingsTable
from iort_contract.messages.analysis.findings import Finding
from iort_contract.messages.analysis.run import AnalysedDrive
from iort_station.cloud import Cloud
from iort_station.errors import StationError
from iort_station.moving import archived, plan, written
from tests.unit.contract.test_findings import FINDING
from tests.unit.contract.test_notes import OneTable, note

TOPIC, DAY = "rec/iort/car7/vesc", "archive/robot=car7/stream=vesc/date=2026-11-22/day.parquet"


class Account:
    """The calls of a cloud that a move makes."""

    endpoint_url, region_name = None, "eu-west-1"

    def __init__(self, number: str, content: bytes, *hours: str) -> None:
        self.number, self.content, self.rows = number, {DAY: content}, [row(hour, content) for hour in hours]
        self.findings = FindingsTable(OneTable(), "findings")

    def client(self, _service: str) -> Account:
        return self

    def output(self, *_: str) -> str:
        return "name"

    def get_caller_identity(self) -> dict[str, str]:
        return {"Account": self.number}

    def get_object(self, *, Bucket: str, Key: str) -> dict[str, Any]:
        return {"Body": io.BytesIO(self.content[Key])}

    def put_object(self, *, Bucket: str, Key: str, Body: bytes) -> None:
        self.content[Key] = Body

    def put_item(self, *, TableName: str, Item: dict[str, Any]) -> None:
        self.rows.append(row(Item["hour"]["S"], self.content[DAY]))


def row(hour: str, content: bytes) -> ArchivedHour:
    return ArchivedHour(TOPIC, hour, DAY, 1, 50, 0, "", hashlib.sha256(content).hexdigest(), 1, 0, 0)


@pytest.fixture(autouse=True)
def accounts(monkeypatch: pytest.MonkeyPatch) -> None:
    class Rows:
        def __init__(self, account: Account, _topic: str) -> None:
            self.rows = account.rows.copy

    monkeypatch.setattr(archived, "Archive", Rows)
    monkeypatch.setattr(written.findings, "table", lambda account: account.findings)


def test_two_profiles_of_one_account_are_one_deployment(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Cloud, "client", lambda cloud, _service: Account("1" if cloud.profile else "2", b""))
    monkeypatch.setattr(Cloud, "region_name", property(lambda cloud: cloud.region))
    here, lab, other = (Cloud(profile=profile, region="eu-west-1") for profile in ("a", "b", None))
    with pytest.raises(StationError, match="the source itself"):
        plan._place(here, lab)
    plan._place(here, other)
    plan._place(here, replace(lab, region="us-east-1"))


def test_a_day_of_the_targets_own_is_not_replaced() -> None:
    source = Account("1", b"source", "2026-11-22T07", "2026-11-22T08")
    new, other = Account("2", b""), Account("2", b"own", "2026-11-22T08", "2026-11-22T09")
    assert move._copy_archive(source, new, TOPIC) == (2, 0)
    assert new.content[DAY] == b"source"
    assert move._copy_archive(source, other, TOPIC) == (0, 1)
    assert other.content[DAY] == b"own"
    assert [one.hour[-2:] for one in other.rows] == ["08", "09"]


def test_what_the_target_has_analysed_again_is_not_replaced() -> None:
    source, target = Account("1", b""), Account("2", b"")
    finding: Finding = FINDING
    robot = finding.drive.robot
    source.findings.put_finding(finding)
    source.findings.put_drive(AnalysedDrive(finding.drive, finding.drive.start_us + 1, "old", 1, {}, {}, {}))
    source.findings.put_note(note(robot=robot))
    assert [written.copy(source, target, robot) for _ in range(2)] == [3, 0]
    again = AnalysedDrive(finding.drive, finding.drive.start_us + 1, "again", 1, {}, {}, {})
    target.findings.put_drive(again)
    target.findings.remove(finding)
    assert written.copy(source, target, robot) == 0
    assert (list(target.findings.drives(robot)), list(target.findings.findings(robot))) == ([again], [])
