"""A day's hours become one object, whatever fails or comes late."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from contextlib import nullcontext, suppress
from dataclasses import replace

import boto3
import pytest
from botocore.exceptions import ClientError

from functions import archive as function
from functions.archive import MOST_OF_A_ROBOT, PUT_OFF_S, margin_s, put_off
from functions.quarantine import entries
from functions.shared import archive_writer
from functions.shared.archive import MARKS, MARKS_A_DAY, Marks
from functions.shared.archive_writer import WRITING_MS, BeingWrittenError
from functions.shared.summary import decode_records
from iort_contract.archive import (
    ALL,
    ARCHIVE,
    DUE,
    HOUR,
    HOUR_REST_MS,
    JOIN,
    PUT_OFF,
    SWEEP,
    TASK,
    Hour,
    Pending,
    content_hash,
    day_key,
    hour_key,
    item_hash,
    refused_key,
)
from iort_contract.tables import BATCH, EXPIRES_S, ROBOT, STREAMS, TOPIC
from iort_contract.topics import RECORD, build_topic
from iort_station.imports.stores import ArchiveStore
from testkit.dynamodb import ARCHIVE as MANIFEST
from testkit.dynamodb import FILES, ROBOTS, TELEMETRY, TOPIC_OF_CAR, item_of_message, record_of
from tests.unit.functions.archiving import (
    CAR,
    DAY,
    DAY_S,
    HOUR_0,
    HOUR_1,
    LATER_MS,
    NOW_MS,
    PENDING,
    RETENTION_S,
    Killed,
    cloud_of_archive,  # noqa: F401 - a fixture
    kill,
)

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


# Every hour is archived once, whatever fails, comes late, or happens at the same time.


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
    message = b'{"batch": "%016d-x", "n": 3}' % (HOUR_0.start_us + 7)
    refused = {**item_of_message(message), EXPIRES_S: first[EXPIRES_S]}
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
    hashes = sorted((item[BATCH]["S"], item_hash(item)) for item in (first, refused, late))
    assert cloud.row().content == content_hash(hashes) != before
    assert (cloud.row().batches, cloud.row().refused) == (2, 1)


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


def meanwhile(monkeypatch, act):
    """Act once, when a run has read the table and written its file."""
    real, acts = archive_writer.write_hour, [act]

    def slow(*args, **kwargs):
        written = real(*args, **kwargs)
        if acts:
            acts.pop()()
        return written

    monkeypatch.setattr(archive_writer, "write_hour", slow)


def test_of_two_runs_at_once_the_slower_one_changes_nothing(cloud, monkeypatch):
    """A run has read the table, then a batch comes, and another run is faster."""
    cloud.store(0, [1, 1, 1])

    def faster():
        cloud.store(1, [2, 2, 2], seq=1)
        cloud.archived()

    meanwhile(monkeypatch, faster)
    with pytest.raises(ClientError, match="pre-conditions"):
        cloud.archived()
    assert cloud.speeds() == [1, 1, 1, 2, 2, 2]
    # The queue delivers the task again.
    cloud.archived()
    assert cloud.speeds() == [1, 1, 1, 2, 2, 2]


class Import:
    """An import of a batch that the table does not have, with clients of its own. It is its cloud, too."""

    namespace = "iort"

    def __init__(self, cloud):
        self.clients = {name: boto3.client(name) for name in ("dynamodb", "s3")}
        self.item = cloud.store(30, [5, 5, 5], seq=1)
        cloud.forget(self.item)

    def client(self, service):
        return self.clients[service]

    def output(self, _noun, name):
        return {"ArchiveTable": MANIFEST, "FilesBucket": FILES}[name]

    def run(self):
        store = ArchiveStore(self, CAR.robot)
        store.items(CAR.name, [self.item])
        store.flush(None)
        store.close()


def hold(monkeypatch, clients, call, act):
    """Act once, before the client that has it makes its call; returns what is still to be done."""
    client = next(one for one in clients if hasattr(one, call))
    real, acts = getattr(client, call), [act]

    def held(**request):
        if acts:
            acts.pop()()
        return real(**request)

    monkeypatch.setattr(client, call, held)
    return acts


def archived_in_the_end(cloud):
    """The queue delivers again what failed."""
    for _ in range(2):
        with suppress(ClientError):
            return cloud.archived(now_ms=LATER_MS)
    raise AssertionError("the function failed twice")


@pytest.mark.parametrize("before", ["nothing", "an hour", "a day"])
@pytest.mark.parametrize(
    ("first", "call"),
    [
        *[("function", call) for call in ("head_object", "get_item", "query", "put_object", "put_item")],
        *[("import", call) for call in ("head_object", "get_item", "put_object", "update_item", "put_item")],
        # Both have written the object, and then the import its row before the function.
        ("import", "row"),
    ],
)
def test_an_import_and_the_function_write_an_hour_at_once_and_nothing_is_lost(
    cloud, monkeypatch, before, first, call
):
    """The first is held before a call, while the other one does its work."""
    if before != "nothing":
        for hour in (HOUR_0, HOUR_1):
            cloud.store(0, [1, 1, 1], hour)
            cloud.archived(hour, LATER_MS)
    if before == "a day":
        assert join_day(cloud) == {"joined": True}
    imports = Import(cloud)
    cloud.store(50, [9, 9, 9], seq=2)
    functions = (cloud.archive.client, cloud.archive.objects._client)
    left = []
    if first == "function":
        left.append(hold(monkeypatch, functions, call, imports.run))
        archived_in_the_end(cloud)
    elif call != "row":
        left.append(hold(monkeypatch, imports.clients.values(), call, lambda: archived_in_the_end(cloud)))
        imports.run()
    else:
        client = imports.client("dynamodb")
        put_item = client.put_item

        def both(**request):
            monkeypatch.setattr(client, "put_item", put_item)
            answers = []
            left.append(hold(monkeypatch, functions, "put_item", lambda: answers.append(put_item(**request))))
            archived_in_the_end(cloud)
            return answers[0]

        monkeypatch.setattr(client, "put_item", both)
        imports.run()
    assert left == [[]], "the call was never made"
    kept = [] if before == "nothing" else [1, 1, 1]
    for now_ms in (LATER_MS, LATER_MS + RETENTION_S * 1000):
        assert cloud.speeds() == [*kept, 5, 5, 5, 9, 9, 9]
        cloud.archived(now_ms=now_ms)
    cloud.marks.add(DAY, 0)
    join_day(cloud, now_ms=int(time.time() * 1000) + WRITING_MS + 1)
    assert cloud.speeds() == [*kept, 5, 5, 5, 9, 9, 9]


def test_an_object_that_is_no_archive_and_that_no_row_names_is_written_anew(cloud):
    cloud.s3.put_object(Bucket=FILES, Key=hour_key(CAR, HOUR_0), Body=b"half an object")
    cloud.store(0, [1, 1, 1])
    cloud.archived()
    assert cloud.speeds() == [1, 1, 1]


def test_a_batch_that_comes_during_the_run_keeps_its_mark(cloud, monkeypatch):
    cloud.store(0, [1, 1, 1])
    meanwhile(monkeypatch, lambda: cloud.store(1, [2, 2, 2], seq=1, now_ms=NOW_MS))
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


# What is due is queued once, and done once.

TOPIC_OF_OTHER = build_topic(RECORD, "other", "vesc")


def calls_of(client, name, monkeypatch):
    """The arguments of a client's calls, which still work."""
    calls, real = [], getattr(client, name)
    monkeypatch.setattr(client, name, lambda **call: calls.append(call) or real(**call))
    return calls


def test_a_live_stream_is_marked_once_an_hour_and_is_due_when_it_is_over(cloud, monkeypatch):
    writes = calls_of(cloud.archive.client, "update_item", monkeypatch)
    for second in range(0, 3600, 600):
        cloud.store(second, [1, 1, 1], seq=second)
    assert len(writes) == 1
    assert function.perform({TASK: DUE}, NOW_MS - 2) == {"tasks": 0, "overdue": 0, "waiting": 0}
    assert function.perform({TASK: DUE}, NOW_MS) == {"tasks": 1, "overdue": 0, "waiting": 0}
    (task,) = cloud.tasks()
    function.handler({"Records": [{"body": json.dumps(task)}]}, None)
    assert cloud.row().batches == 6
    # A late batch marks its hour again, for some minutes.
    cloud.store(3599, [2, 2, 2], seq=9)
    cloud.marks.note(TOPIC_OF_CAR, [HOUR_0.start_us], NOW_MS + 1)
    assert cloud.marks.due_ms(PENDING) == NOW_MS + 1 + HOUR_REST_MS
    assert len(writes) == 1 + 2  # and the day's


def test_a_task_that_an_earlier_one_has_done_reads_nothing(cloud, monkeypatch):
    """Behind a long queue, each hour's plan queues the same hour again."""
    cloud.store(0, [1, 1, 1])
    for _ in range(2):
        assert function.perform({TASK: DUE}, NOW_MS)["tasks"] == 1
    first, second = cloud.tasks()
    function.perform(first, NOW_MS)
    assert cloud.row().batches == 1
    monkeypatch.setattr(cloud.archive.client, "query", kill)
    assert function.perform(second, NOW_MS) == {}


def test_the_hours_of_a_clock_that_is_ahead_do_not_wait_for_their_time(cloud):
    ahead = Hour(HOUR_0.number + 1000)
    cloud.marks.note(TOPIC_OF_CAR, [ahead.start_us], NOW_MS)
    assert cloud.marks.due_ms(Pending(TOPIC_OF_CAR, str(ahead))) == NOW_MS + HOUR_REST_MS


def test_a_task_that_failed_for_good_is_in_quarantine_under_its_robot():
    body = json.dumps({TASK: ARCHIVE, TOPIC: TOPIC_OF_CAR, HOUR: str(HOUR_0)})
    (entry,) = entries(body, lambda _: [])
    assert (entry.robot, entry.reason) == ("car", f"the archive failed in five attempts: {ARCHIVE} {HOUR_0}")


def test_the_marks_of_a_fleet_are_in_many_partitions_and_come_oldest_first(cloud):
    """At a full hour all streams are marked within a second."""
    topics = [build_topic(RECORD, f"car{number}", "vesc") for number in range(40)]
    for number, topic in enumerate(topics):
        cloud.marks.note(topic, [Hour(HOUR_0.number + number % 3).start_us], NOW_MS)

    found = cloud.pending()

    partitions = {pending.key[TOPIC]["S"] for pending in found}
    assert len(partitions) == 8
    assert {pending.topic for pending in found} == set(topics)
    assert [pending.period for pending in found] == sorted(pending.period for pending in found)


def test_a_robot_that_invents_hours_has_so_many_marks_and_the_others_have_theirs(dynamodb):
    written = []

    class Client:
        exceptions = dynamodb.exceptions

        def update_item(self, **update):
            written.append(update["Key"][HOUR]["S"])

    marks = Marks(Client(), "archive")
    marks.note(TOPIC_OF_CAR, [Hour(number).start_us for number in range(20_000)], NOW_MS)
    marks.note(TOPIC_OF_OTHER, [HOUR_0.start_us], NOW_MS)

    assert len(written) == MARKS + 1
    assert written[-1].endswith(TOPIC_OF_OTHER)
    marks.note(TOPIC_OF_CAR, [Hour(number).start_us for number in range(20_000)], NOW_MS + 86_400_000)
    assert len(written) <= 1 + MARKS + MARKS_A_DAY


def test_a_plan_takes_so_many_hours_of_a_robot_and_forgets_none(cloud):
    hours = [Hour(HOUR_0.number - number) for number in range(MOST_OF_A_ROBOT + 5)]
    cloud.marks.note(TOPIC_OF_CAR, [hour.start_us for hour in hours], hours[-1].end_us // 1000)
    cloud.marks.note(TOPIC_OF_OTHER, [HOUR_0.start_us], HOUR_0.end_us // 1000)

    planned = function.perform({TASK: DUE}, NOW_MS)

    tasks = [task for task in cloud.tasks() if task[TASK] == ARCHIVE]
    assert planned["waiting"] == 5
    assert [task[TOPIC] for task in tasks].count(TOPIC_OF_CAR) == MOST_OF_A_ROBOT
    assert [task[TOPIC] for task in tasks].count(TOPIC_OF_OTHER) == 1
    # Their marks stay until they are done.
    assert len(cloud.pending()) == MOST_OF_A_ROBOT + 5 + 1


def test_a_task_names_its_robot_so_that_a_queue_can_be_fair(cloud, monkeypatch):
    sent = calls_of(cloud.archive.queue, "send_message_batch", monkeypatch)
    cloud.marks.note(TOPIC_OF_CAR, [HOUR_0.start_us], HOUR_0.start_us // 1000)
    function.perform({TASK: DUE}, NOW_MS)
    assert [entry["MessageGroupId"] for call in sent for entry in call["Entries"]] == ["car"]


# Nothing expires unarchived.


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
            fails = task[TASK] == ARCHIVE
            with pytest.raises(ClientError, match="no bucket") if fails else nullcontext():
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
    near_ms = (cloud.expiries()[0] - margin_s(RETENTION_S)) * 1000
    lose_mark(cloud)
    tasks = []

    def kinds(hours):
        now_ms = near_ms + hours * 3_600_000
        cloud.marks.note(TOPIC_OF_CAR, [HOUR_0.start_us], now_ms)
        assert cloud.marks.due_ms(PENDING) > now_ms
        overdue = function.perform({TASK: DUE}, now_ms)["overdue"]
        tasks[:] = [task for task in cloud.tasks() if task[HOUR] == str(HOUR_0)]
        return overdue, [task[TASK] for task in tasks]

    assert kinds(0) == (0, [])
    assert kinds(2) == (0, [ARCHIVE])
    assert kinds(4) == (1, [PUT_OFF, ARCHIVE])
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
    key = {name: item[name] for name in (TOPIC, BATCH)}
    changed = cloud.dynamodb.get_item(TableName=TELEMETRY, Key=key)["Item"]
    assert changed[EXPIRES_S] != item[EXPIRES_S]
    assert not decode_records([record_of(changed, kind="MODIFY")]).batches
    assert decode_records([record_of(item, kind="MODIFY")]).batches[TOPIC_OF_CAR]
    # What waited, or is replayed, comes as it is stored.
    assert decode_records([record_of(changed)]).batches[TOPIC_OF_CAR]


def test_expiries_are_put_off_even_where_pyarrow_fails_to_load():
    code = "import sys; sys.modules['pyarrow'] = None; import functions.archive as a; a.plan_due, a.put_off"
    subprocess.run([sys.executable, "-c", code], check=True)


# A sweep finds what has lost its mark, before it expires.


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


def test_a_damaged_row_of_the_manifest_stops_no_sweep(cloud):
    for hour in (HOUR_0, HOUR_1):
        cloud.store(0, [1, 1, 1], hour)
    cloud.archived(HOUR_0)
    lose_mark(cloud, HOUR_1)
    (row,) = (row for row in cloud.dynamodb.scan(TableName=MANIFEST)["Items"] if "sha256" in row)
    cloud.dynamodb.put_item(TableName=MANIFEST, Item=row | {"sha256": {"N": "1"}})
    assert str(HOUR_1) in swept(cloud, **{ALL: True})


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
