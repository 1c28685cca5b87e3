"""Nothing expires unarchived."""

from __future__ import annotations

import subprocess
import sys

import pytest
from botocore.exceptions import ClientError

from functions import archive as function
from functions.archive import PUT_OFF_S, margin_s, put_off
from functions.shared.summary import decode_records
from iort_contract.archive import ARCHIVE, DUE, HOUR, PUT_OFF, TASK
from iort_contract.tables import BATCH, EXPIRES_S, TOPIC
from testkit.dynamodb import TELEMETRY, TOPIC_OF_CAR, record_of
from tests.unit.functions.archive.archiving import HOUR_0, NOW_MS, PENDING, RETENTION_S


def test_what_cannot_be_archived_does_not_expire(cloud, monkeypatch, capsys):
    """The bucket fails for 90 days, and a task after five attempts goes to quarantine every hour."""
    cloud.store(0, [1, 1, 1])
    expires_s = cloud.expiries()[0]

    def failing(**_):
        raise ClientError({"Error": {"Code": "InternalError", "Message": "no bucket"}}, "PutObject")

    def plan(now_s):
        function.perform({TASK: DUE}, now_s * 1000)
        tasks = cloud.tasks()
        for task in tasks:
            if task[TASK] == ARCHIVE:
                with pytest.raises(ClientError, match="no bucket"):
                    function.perform(task, now_s * 1000)
            else:
                function.perform(task, now_s * 1000)
        return [task[TASK] for task in tasks]

    monkeypatch.setattr(cloud.archive.objects._client, "put_object", failing)
    assert plan(NOW_MS // 1000) == [ARCHIVE]
    capsys.readouterr()
    # The alarm's metric, after three hours. The expiry is looked up once, and is far away.
    late_s = NOW_MS // 1000 + 4 * 3600
    assert plan(late_s) == [PUT_OFF, ARCHIVE]
    assert plan(late_s + 3600) == [ARCHIVE]
    assert '"TasksOverdue":1' in capsys.readouterr().out
    assert cloud.expiries() == [expires_s]
    near_s = expires_s - margin_s(RETENTION_S)
    assert plan(near_s) == [PUT_OFF, ARCHIVE]
    assert cloud.expiries() == [near_s + PUT_OFF_S]
    assert '"ExpiriesPutOff":1' in capsys.readouterr().out
    assert plan(near_s + 3600) == [ARCHIVE]
    # Months later it is still there, and is archived once the bucket is back.
    again_s = near_s + PUT_OFF_S - margin_s(RETENTION_S)
    assert plan(again_s) == [PUT_OFF, ARCHIVE]
    monkeypatch.undo()
    cloud.archived(now_ms=again_s * 1000)
    assert cloud.speeds() == [1, 1, 1]
    assert PENDING not in cloud.pending()


def test_late_batches_that_keep_coming_delay_neither_their_hour_nor_its_put_off(cloud):
    """A batch every ten minutes moves the mark before it is due, and no run succeeds for hours."""
    cloud.store(0, [1, 1, 1])
    expires_s = cloud.expiries()[0]
    near_ms = (expires_s - margin_s(RETENTION_S)) * 1000
    cloud.marks.remove(PENDING, cloud.marks.due_ms(PENDING))

    def plan(now_ms):
        cloud.marks.note(TOPIC_OF_CAR, [HOUR_0.start_us], now_ms)
        assert cloud.marks.due_ms(PENDING) > now_ms
        told = function.perform({TASK: DUE}, now_ms)
        return told["overdue"], [task for task in cloud.tasks() if task[HOUR] == str(HOUR_0)]

    def kinds(hours):
        overdue, tasks = plan(near_ms + hours * 3_600_000)
        return overdue, [task[TASK] for task in tasks]

    assert kinds(0) == (0, [])
    assert kinds(2) == (0, [ARCHIVE])
    overdue, tasks = plan(near_ms + 4 * 3_600_000)
    assert (overdue, [task[TASK] for task in tasks]) == (1, [PUT_OFF, ARCHIVE])
    for task in tasks:
        function.perform(task, near_ms + 4 * 3_600_000)
    assert cloud.expiries() == [near_ms // 1000 + 4 * 3600 + PUT_OFF_S]
    # That run has archived it, so the mark that stays begins anew.
    assert cloud.speeds() == [1, 1, 1]
    assert PENDING in cloud.pending()
    assert kinds(5) == (0, [])
    assert kinds(6) == (0, [ARCHIVE])


def test_lambda_2_ignores_an_expiry_put_off_but_not_a_batch_sent_again(cloud):
    item = cloud.store(0, [1, 1, 1])
    put_off(cloud.archive, PENDING, int(item[EXPIRES_S]["N"]) * 1000)
    changed = cloud.dynamodb.get_item(TableName=TELEMETRY, Key={name: item[name] for name in (TOPIC, BATCH)})[
        "Item"
    ]
    assert changed[EXPIRES_S] != item[EXPIRES_S]
    assert not decode_records([record_of(changed, kind="MODIFY")]).batches
    assert decode_records([record_of(item, kind="MODIFY")]).batches[TOPIC_OF_CAR]
    # What waited, or is replayed, comes as it is stored.
    assert decode_records([record_of(changed)]).batches[TOPIC_OF_CAR]


def test_expiries_are_put_off_even_where_pyarrow_fails_to_load():
    code = "import sys; sys.modules['pyarrow'] = None; import functions.archive as a; a.plan_due, a.put_off"
    subprocess.run([sys.executable, "-c", code], check=True)
