"""What is due is queued once, and done once."""

from __future__ import annotations

import json

from functions import archive as function
from functions.archive import MOST_OF_A_ROBOT
from functions.quarantine import entries
from functions.shared.archive import MARKS, MARKS_A_DAY, Marks
from iort_contract.archive import ARCHIVE, DUE, HOUR, HOUR_REST_MS, TASK, Hour, Pending
from iort_contract.tables import TOPIC
from iort_contract.topics import RECORD, build_topic
from testkit.dynamodb import TOPIC_OF_CAR
from tests.unit.functions.archive.archiving import HOUR_0, NOW_MS, PENDING, kill

TOPIC_OF_OTHER = build_topic(RECORD, "other", "vesc")


def test_a_live_stream_is_marked_once_an_hour_and_is_due_when_it_is_over(cloud, monkeypatch):
    writes = []
    real = cloud.archive.client.update_item
    monkeypatch.setattr(
        cloud.archive.client, "update_item", lambda **update: writes.append(update) or real(**update)
    )
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
    sent = []
    real = cloud.archive.queue.send_message_batch
    monkeypatch.setattr(
        cloud.archive.queue, "send_message_batch", lambda **call: sent.extend(call["Entries"]) or real(**call)
    )
    cloud.marks.note(TOPIC_OF_CAR, [HOUR_0.start_us], HOUR_0.start_us // 1000)

    function.perform({TASK: DUE}, NOW_MS)

    assert [entry["MessageGroupId"] for entry in sent] == ["car"]
