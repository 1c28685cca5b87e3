"""A sweep finds what has lost its mark, before it expires."""

from __future__ import annotations

from dataclasses import replace

import pytest

from functions import archive as function
from functions.archive import margin_s
from iort_contract.archive import ALL, HOUR, HOUR_REST_MS, SWEEP, TASK, Hour, Pending
from iort_contract.tables import BATCH, EXPIRES_S, ROBOT, STREAMS, TOPIC
from testkit.dynamodb import ROBOTS, TELEMETRY, TOPIC_OF_CAR
from tests.unit.functions.archive.archiving import (
    DAY_S,
    HOUR_0,
    HOUR_1,
    LATER_MS,
    NOW_MS,
    PENDING,
    RETENTION_S,
)


def lose_mark(cloud, hour=HOUR_0):
    pending = Pending(TOPIC_OF_CAR, str(hour))
    cloud.marks.remove(pending, cloud.marks.due_ms(pending))


def swept(cloud, now_ms=LATER_MS, **more):
    function.perform({TASK: SWEEP, TOPIC: TOPIC_OF_CAR, **more}, now_ms)
    return [task[HOUR] for task in cloud.tasks()]


def test_a_sweep_finds_hours_without_a_mark(cloud):
    cloud.dynamodb.put_item(TableName=ROBOTS, Item={ROBOT: {"S": "car"}, STREAMS: {"SS": ["vesc", "lidar"]}})
    for hour in (HOUR_0, HOUR_1):
        cloud.store(0, [1, 1, 1], hour)
        lose_mark(cloud, hour)
    assert not cloud.pending()
    assert function.perform({TASK: SWEEP}, LATER_MS)["tasks"] > 2
    sweeps = cloud.tasks()
    assert {TASK: SWEEP, TOPIC: TOPIC_OF_CAR} in sweeps
    # Nothing expires soon.
    assert function.perform({TASK: SWEEP, TOPIC: TOPIC_OF_CAR}, LATER_MS) == {"tasks": 0}
    expiring_ms = (HOUR_0.end_us // 1_000_000 + RETENTION_S - margin_s(RETENTION_S)) * 1000
    assert function.perform({TASK: SWEEP, TOPIC: TOPIC_OF_CAR}, expiring_ms) == {"tasks": 2}
    assert cloud.pending() == [Pending(TOPIC_OF_CAR, str(hour)) for hour in (HOUR_0, HOUR_1)]
    # The operator asks for all, at any time; the hour that is not over stays.
    now_ms = HOUR_1.start_us // 1000 + HOUR_REST_MS
    assert function.perform({TASK: SWEEP, TOPIC: TOPIC_OF_CAR, ALL: True}, now_ms) == {"tasks": 1}


def test_a_sweep_finds_a_late_batch_without_a_mark_before_the_hour_expires(cloud):
    cloud.store(0, [1, 1, 1])
    cloud.archived()
    begins_ms = (HOUR_0.start_us // 1_000_000 + RETENTION_S - 2 * margin_s(RETENTION_S)) * 1000
    night_ms = begins_ms + 20 * 3_600_000
    assert not swept(cloud, night_ms)
    cloud.store(1, [2, 2, 2], seq=1)
    assert PENDING not in cloud.pending()
    assert not swept(cloud, begins_ms - 2)
    assert swept(cloud, night_ms) == [str(HOUR_0)]
    cloud.archived(now_ms=night_ms)
    assert cloud.speeds() == [1, 1, 1, 2, 2, 2]


@pytest.mark.parametrize("ahead_days", [-300, 30, 365])
def test_a_sweep_counts_hours_of_a_wrong_clock_before_they_expire(cloud, ahead_days):
    """They expire by their receipt, and not by their hour."""
    hour = Hour(HOUR_0.number + 24 * ahead_days)

    def store(second):
        item = cloud.store(second, [1, 1, 1], hour, seq=second)
        item[EXPIRES_S] = {"N": str(HOUR_0.start_us // 1_000_000 + RETENTION_S)}
        cloud.dynamodb.put_item(TableName=TELEMETRY, Item=item)

    store(0)
    cloud.archived(hour, now_ms=max(NOW_MS, hour.end_us // 1000 + HOUR_REST_MS))
    begins_ms = (HOUR_0.start_us // 1_000_000 + RETENTION_S - 2 * margin_s(RETENTION_S)) * 1000
    assert not swept(cloud, begins_ms)
    store(1)
    if cloud.marks.due_ms(Pending(TOPIC_OF_CAR, str(hour))) is not None:
        lose_mark(cloud, hour)
    assert not swept(cloud, begins_ms - 1000)
    assert swept(cloud, begins_ms + 20 * 3_600_000) == [str(hour)]


def test_a_sweep_finds_hours_of_a_clock_that_is_ahead(cloud):
    ahead = Hour(HOUR_0.number + 365 * 24)
    cloud.store(0, [1, 1, 1], ahead)
    lose_mark(cloud, ahead)
    assert swept(cloud, NOW_MS) == [str(ahead)]


def test_a_sweep_comes_in_time_for_a_retention_of_a_day(cloud, monkeypatch):
    short = replace(cloud.archive, given=replace(cloud.archive.given, retention_s=DAY_S))
    monkeypatch.setattr(function, "archive", lambda: short)
    cloud.store(0, [1, 1, 1])
    lose_mark(cloud)
    assert swept(cloud, NOW_MS) == [str(HOUR_0)]


@pytest.mark.parametrize("key", ["1", "12abc", "0000000000000000", "9" * 16 + "-x"])
def test_a_key_without_a_time_does_not_stop_a_sweep(cloud, key):
    cloud.dynamodb.put_item(
        TableName=TELEMETRY, Item={TOPIC: {"S": TOPIC_OF_CAR}, BATCH: {"S": key}, "codec": {"NULL": True}}
    )
    cloud.store(0, [1, 1, 1])
    others = {"0": ["1970-01-01T00"], "9": ["2286-11-20T17"]}.get(key[0], [])
    assert sorted(swept(cloud, **{ALL: True})) == sorted([*others, str(HOUR_0)])
