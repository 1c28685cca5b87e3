"""What a robot records a day is counted in its row, at little cost, and too much is an alarm."""

from __future__ import annotations

import pytest

from functions.summarize import EVERY_S, PARTS, Volume, size_of
from iort_contract.tables import BATCH, PUT_OFF_TO_S, RECORD_BYTES, RECORD_DAY, ROBOT, TOPIC
from testkit.dynamodb import ROBOTS
from tests.unit.functions.summary.summarizing import counted

MOST, NOON_S = 1_000_000, 1_700_049_600.0
CAR = {"S": "car7"}


def change(size: int, *, robot: str = "car7", **more: dict) -> dict:
    keys = {TOPIC: {"S": f"dt/iort/{robot}/vesc"}, BATCH: {"S": "1"}}
    image = {**keys, "samples": {"S": "a" * size}, **more}
    return {"Keys": keys, "NewImage": image, "SequenceNumber": "1"}


@pytest.fixture
def row(dynamodb):
    dynamodb.put_item(TableName=ROBOTS, Item={ROBOT: CAR})
    return lambda: dynamodb.get_item(TableName=ROBOTS, Key={ROBOT: CAR})["Item"]


@pytest.fixture
def volume(dynamodb):
    return Volume(dynamodb, ROBOTS, MOST)


def test_a_part_of_the_day_or_some_minutes_are_one_write(row, volume):
    part = change(MOST // PARTS // 2)
    volume.note([part], NOON_S)
    assert row() == {ROBOT: CAR}
    volume.note([part], NOON_S + 1)
    size = 2 * size_of(part["NewImage"])
    assert row() == {ROBOT: CAR, RECORD_DAY: {"S": "2023-11-15"}, RECORD_BYTES: {"N": str(size)}}
    # A small robot's count is written after some minutes, also by another environment.
    volume.note([change(10)], NOON_S + 2)
    volume.note([], NOON_S + 2 + EVERY_S)
    assert int(row()[RECORD_BYTES]["N"]) == size + size_of(change(10)["NewImage"])


def test_above_its_bytes_a_robot_is_named_and_counted_and_the_next_day_is_new(row, volume, caplog, capsys):
    big = change(MOST // 2)
    volume.note([big], NOON_S)
    assert counted(capsys) == {}
    volume.note([big], NOON_S)
    assert "car7 has recorded" in caplog.text
    assert f"more than its {MOST}" in caplog.text
    assert counted(capsys) == {"RobotsOverVolume": 1}
    volume.note([big], NOON_S + 86_400)
    assert row()[RECORD_DAY] == {"S": "2023-11-16"}
    assert row()[RECORD_BYTES] == {"N": str(size_of(big["NewImage"]))}


def test_what_no_robot_wrote_is_not_counted(row, volume):
    removed = {name: value for name, value in change(9).items() if name != "NewImage"}
    foreign = {**change(MOST), "Keys": {TOPIC: {"S": "nonsense"}}}
    volume.note([change(MOST, **{PUT_OFF_TO_S: {"N": "1"}}), removed, foreign], NOON_S)
    assert row() == {ROBOT: CAR}


def test_a_removed_robot_gets_no_row(dynamodb, volume):
    volume.note([change(MOST, robot="gone")], NOON_S)
    assert "Item" not in dynamodb.get_item(TableName=ROBOTS, Key={ROBOT: {"S": "gone"}})


def test_a_failed_count_stops_nothing(dynamodb, caplog):
    Volume(dynamodb, "no-such-table", MOST).note([change(MOST)], NOON_S)
    assert "are not counted" in caplog.text


def test_bytes_in_an_event_are_in_base64():
    assert size_of({"samples": {"B": "AAAA"}}) == size_of({"samples": {"B": b"AAA"}})
