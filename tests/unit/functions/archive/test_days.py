"""A day's hours become one object, whatever fails or comes late."""

from __future__ import annotations

import time
from contextlib import nullcontext

import pytest

from functions import archive as function
from functions.shared.archive_writer import WRITING_MS, BeingWrittenError
from iort_contract.archive import HOUR, JOIN, TASK, day_key, hour_key
from iort_contract.tables import TOPIC
from testkit.dynamodb import TOPIC_OF_CAR
from tests.unit.functions.archive.archiving import CAR, DAY, HOUR_0, HOUR_1, LATER_MS, Killed, kill

OBJECT_OF_DAY = day_key(CAR, HOUR_0)


def join_day(cloud, now_ms=LATER_MS):
    return function.perform({TASK: JOIN, TOPIC: TOPIC_OF_CAR, HOUR: HOUR_0.date}, now_ms)


@pytest.fixture
def two_hours(cloud):
    for i, hour in enumerate((HOUR_0, HOUR_1)):
        cloud.store(0, [i, i, i], hour)
        cloud.archived(hour, LATER_MS)
    return cloud


def test_a_day_becomes_one_object_and_a_late_batch_another_one(two_hours, monkeypatch):
    cloud = two_hours
    cloud.marks.remove(DAY, cloud.marks.due_ms(DAY))
    cloud.marks.add(DAY, 0)
    assert join_day(cloud) == {"joined": True}
    assert cloud.keys() == [OBJECT_OF_DAY]
    assert (cloud.speeds(HOUR_0), cloud.speeds(HOUR_1)) == ([0, 0, 0], [1, 1, 1])
    assert not cloud.pending()
    # A run of an hour in it finds nothing to do.
    cloud.archived(HOUR_0, LATER_MS)
    assert cloud.keys() == [OBJECT_OF_DAY]

    cloud.store(5, [7, 7, 7], HOUR_1, seq=1)
    cloud.archived(HOUR_1, LATER_MS)
    assert cloud.keys() == [hour_key(CAR, HOUR_1), OBJECT_OF_DAY]
    assert cloud.speeds(HOUR_1) == [1, 1, 1, 7, 7, 7]
    join_day(cloud)
    assert cloud.keys() == [OBJECT_OF_DAY]
    assert (cloud.speeds(HOUR_0), cloud.speeds(HOUR_1)) == ([0, 0, 0], [1, 1, 1, 7, 7, 7])
    # Days above the limit stay as hours.
    cloud.store(6, [8, 8, 8], HOUR_1, seq=2)
    cloud.archived(HOUR_1, LATER_MS)
    monkeypatch.setattr("functions.shared.archive_writer.MOST_BYTES", 1)
    assert join_day(cloud) == {"joined": False}
    assert cloud.speeds(HOUR_1) == [1, 1, 1, 7, 7, 7, 8, 8, 8]


@pytest.mark.parametrize("where", ["put_object", "transact_write_items", "delete_object"])
def test_a_day_is_whole_whenever_its_join_is_killed(two_hours, monkeypatch, where):
    cloud = two_hours
    client = cloud.archive.client if where == "transact_write_items" else cloud.archive.objects._client
    with monkeypatch.context() as patched:
        patched.setattr(client, where, kill)
        with pytest.raises(Killed):
            join_day(cloud)
    assert (cloud.speeds(HOUR_0), cloud.speeds(HOUR_1)) == ([0, 0, 0], [1, 1, 1])
    join_day(cloud, now_ms=int(time.time() * 1000) + WRITING_MS + 1)
    assert cloud.keys() == [OBJECT_OF_DAY]
    assert (cloud.speeds(HOUR_0), cloud.speeds(HOUR_1)) == ([0, 0, 0], [1, 1, 1])


def test_a_late_batch_during_the_join_is_not_lost(two_hours, monkeypatch):
    """Its run writes the hour's object again, just before the join removes it."""
    cloud = two_hours
    real = cloud.archive.client.transact_write_items

    def meanwhile(**request):
        answer = real(**request)
        cloud.store(5, [7, 7, 7], HOUR_1, seq=1)
        cloud.archived(HOUR_1, LATER_MS)
        return answer

    monkeypatch.setattr(cloud.archive.client, "transact_write_items", meanwhile)
    join_day(cloud)
    assert cloud.speeds(HOUR_1) == [1, 1, 1, 7, 7, 7]
    assert cloud.speeds(HOUR_0) == [0, 0, 0]


@pytest.mark.parametrize("joined_before", [False, True])
def test_a_join_leaves_an_object_whose_row_is_still_to_come(two_hours, monkeypatch, joined_before):
    """A late batch's run has written the hour's object, and the join is faster than its row."""
    cloud = two_hours
    if joined_before:
        join_day(cloud)
    cloud.store(5, [7, 7, 7], HOUR_1, seq=1)
    cloud.marks.add(DAY, 0)
    real = cloud.archive.client.put_item

    def meanwhile(**request):
        monkeypatch.setattr(cloud.archive.client, "put_item", real)
        with nullcontext() if joined_before else pytest.raises(BeingWrittenError):
            join_day(cloud)
        return real(**request)

    monkeypatch.setattr(cloud.archive.client, "put_item", meanwhile)
    cloud.archived(HOUR_1, LATER_MS)
    assert cloud.speeds(HOUR_1) == [1, 1, 1, 7, 7, 7]
    assert DAY in cloud.pending()
    join_day(cloud)
    assert cloud.keys() == [OBJECT_OF_DAY]
    assert cloud.speeds(HOUR_1) == [1, 1, 1, 7, 7, 7]
