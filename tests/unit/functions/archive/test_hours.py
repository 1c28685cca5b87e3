"""Every hour is archived once, whatever fails, comes late, or happens at the same time."""

from __future__ import annotations

import json
from dataclasses import replace

import pytest
from botocore.exceptions import ClientError

from functions.shared import archive_writer
from iort_contract.archive import HOUR_REST_MS, content_hash, hour_key, item_hash, refused_key
from iort_contract.tables import BATCH, EXPIRES_S
from testkit.dynamodb import FILES, TELEMETRY, item_of_message
from tests.unit.functions.archive.archiving import (
    CAR,
    DAY,
    DAY_S,
    HOUR_0,
    NOW_MS,
    PENDING,
    RETENTION_S,
    Killed,
    kill,
)


def test_an_hour_is_archived_once_and_nothing_changes_afterwards(cloud, capsys):
    items = [cloud.store(second, [second, 1.5, None], seq=second) for second in (0, 5)]
    cloud.archived()
    row = cloud.row()
    assert (row.batches, row.samples, row.refused, row.key) == (2, 6, 0, hour_key(CAR, HOUR_0))
    assert row.content == content_hash((item[BATCH]["S"], item_hash(item)) for item in items)
    assert row.first_expires_s == HOUR_0.start_us // 1_000_000 + RETENTION_S
    assert cloud.speeds() == [0, 1.5, None, 5, 1.5, None]
    # What is left to do is to join the day.
    assert cloud.pending() == [DAY]
    assert '"HoursArchived":1' in capsys.readouterr().out
    before = cloud.s3.head_object(Bucket=FILES, Key=row.key)
    cloud.archived(now_ms=NOW_MS + 5)
    assert cloud.row() == row
    assert cloud.s3.head_object(Bucket=FILES, Key=row.key)["LastModified"] == before["LastModified"]
    assert not capsys.readouterr().out


def test_a_late_batch_rewrites_its_hour_also_after_the_others_have_expired(cloud):
    first = cloud.store(0, [1, 1, 1])
    refused = {
        **item_of_message(b'{"batch": "%016d-x", "n": 3}' % (HOUR_0.start_us + 7)),
        EXPIRES_S: first[EXPIRES_S],
    }
    cloud.dynamodb.put_item(TableName=TELEMETRY, Item=refused)
    cloud.archived()
    assert cloud.s3.get_object(Bucket=FILES, Key=refused_key(CAR, HOUR_0))["Body"].read() == (
        json.dumps(refused, separators=(",", ":")).encode() + b"\n"
    )
    assert cloud.row().refused == 1
    before = cloud.row().content
    # The late batch comes on the day that the others go.
    late_ms = cloud.row().first_expires_s * 1000
    cloud.forget(first)
    cloud.forget(refused)
    late = cloud.store(3, [2, 2, 2], seq=1)
    cloud.archived(now_ms=late_ms)
    assert cloud.speeds() == [1, 1, 1, 2, 2, 2]
    assert cloud.row().content == content_hash(
        (item[BATCH]["S"], item_hash(item))
        for item in sorted((first, refused, late), key=lambda i: i[BATCH]["S"])
    )
    assert (cloud.row().batches, cloud.row().refused) == (2, 1)
    assert cloud.row().content != before


def test_an_hour_never_shrinks(cloud):
    """Somebody has deleted items by hand, before their time."""
    first = cloud.store(0, [1, 1, 1])
    cloud.store(1, [2, 2, 2], seq=1)
    cloud.archived()
    cloud.forget(first)
    cloud.archived()
    assert cloud.speeds() == [1, 1, 1, 2, 2, 2]
    # Late ones do not hide it by their number.
    cloud.store(2, [3, 3, 3], seq=2)
    cloud.archived()
    assert cloud.speeds() == [1, 1, 1, 2, 2, 2, 3, 3, 3]


@pytest.mark.parametrize("where", ["put_object", "put_item"])
@pytest.mark.parametrize("late", [False, True])
def test_killed_in_the_middle_the_next_run_ends_the_work(cloud, monkeypatch, where, late):
    cloud.store(0, [1, 1, 1])
    if late:
        cloud.archived()
        cloud.store(1, [2, 2, 2], seq=1, now_ms=NOW_MS)
    before = cloud.row()
    client = cloud.archive.objects._client if where == "put_object" else cloud.archive.client
    with monkeypatch.context() as patched:
        patched.setattr(client, where, kill)
        with pytest.raises(Killed):
            cloud.archived()
    assert cloud.row() == before
    assert PENDING in cloud.pending()
    cloud.archived(now_ms=NOW_MS + HOUR_REST_MS)
    assert cloud.speeds() == ([1, 1, 1, 2, 2, 2] if late else [1, 1, 1])
    assert cloud.pending() == [DAY]


def test_of_two_runs_at_once_the_slower_one_changes_nothing(cloud, monkeypatch):
    """A run has read the table, then a batch comes, and another run is faster."""
    cloud.store(0, [1, 1, 1])
    real, other = archive_writer.write_hour, []

    def slow(*args, **kwargs):
        written = real(*args, **kwargs)
        if not other:
            other.append(True)
            cloud.store(1, [2, 2, 2], seq=1)
            cloud.archived()
        return written

    monkeypatch.setattr(archive_writer, "write_hour", slow)
    with pytest.raises(ClientError, match="pre-conditions"):
        cloud.archived()
    assert cloud.speeds() == [1, 1, 1, 2, 2, 2]
    # The queue delivers the task again.
    cloud.archived()
    assert cloud.speeds() == [1, 1, 1, 2, 2, 2]


def test_a_batch_that_comes_during_the_run_keeps_its_mark(cloud, monkeypatch):
    cloud.store(0, [1, 1, 1])
    real = archive_writer.write_hour

    def meanwhile(*args, **kwargs):
        written = real(*args, **kwargs)
        cloud.store(1, [2, 2, 2], seq=1, now_ms=NOW_MS)
        return written

    with monkeypatch.context() as patched:
        patched.setattr(archive_writer, "write_hour", meanwhile)
        cloud.archived()
    assert cloud.speeds() == [1, 1, 1]
    assert PENDING in cloud.pending()
    cloud.archived(now_ms=NOW_MS + HOUR_REST_MS)
    assert cloud.speeds() == [1, 1, 1, 2, 2, 2]
    assert cloud.pending() == [DAY]


def test_a_batch_sent_again_after_the_retention_became_shorter_is_read_from_the_archive_in_time(cloud):
    item = cloud.store(0, [1, 1, 1])
    cloud.archived()
    expires_s = cloud.row().first_expires_s
    again = {**item, EXPIRES_S: {"N": str(expires_s - 60 * DAY_S)}}
    cloud.dynamodb.put_item(TableName=TELEMETRY, Item=again)
    before = cloud.row()
    cloud.archived()
    assert cloud.row() == replace(before, first_expires_s=expires_s - 60 * DAY_S)
