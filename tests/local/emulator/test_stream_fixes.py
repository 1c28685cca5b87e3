"""The embedded cloud's stream mappings, in this process: ministack's tables and queues, and a test
function.
"""

from __future__ import annotations

import json
import threading
import time
from contextlib import suppress

import pytest
from ministack.core.responses import request_scope
from ministack.services import dynamodb, lambda_svc, sqs

from local.emulator.fixes.stream_retries import StreamMappings
from local.persistence import queues
from local.persistence.ledger import LedgerError
from testkit.waiting import GUARD_S
from tests.local.emulator import series_table
from tests.local.persistence.in_process import ACCOUNT, REGION, kept

QUEUE_ARN = f"arn:aws:sqs:{REGION}:{ACCOUNT}:gap-destination"


@pytest.fixture
def streams(tmp_path):
    with kept(tmp_path / "ledger.db") as streams:
        yield streams


@pytest.fixture
def cloud(monkeypatch, streams):
    """Make a table with a stream, a queue, and a function whose answer the test sets."""
    with request_scope(ACCOUNT, REGION):
        series_table.create("gap", StreamSpecification={"StreamEnabled": True, "StreamViewType": "NEW_IMAGE"})
        sqs._act_create_queue({"QueueName": "gap-destination"}, "")
        mapping = {
            "UUID": "gap-mapping",
            "EventSourceArn": dynamodb._tables["gap"]["LatestStreamArn"],
            "FunctionName": "gap",
            "StartingPosition": "TRIM_HORIZON",
            "BatchSize": 4,
            "BisectBatchOnFunctionError": True,
            "MaximumRetryAttempts": 1,
            "FunctionResponseTypes": ["ReportBatchItemFailures"],
            "DestinationConfig": {"OnFailure": {"Destination": QUEUE_ARN}},
        }
        lambda_svc._esms["gap-mapping"] = mapping
        function = {"config": {"FunctionArn": "arn:gap", "FunctionName": "gap"}}
        monkeypatch.setattr(
            lambda_svc, "_get_func_record_for_qualifier", lambda *_: (function, function["config"])
        )
        yield Cloud(monkeypatch, streams)
        # An invocation notes how far its mapping is after the function has answered.
        for thread in threading.enumerate():
            if thread.name.endswith("(_invoke)"):
                thread.join(GUARD_S)
        del lambda_svc._esms["gap-mapping"]
        dynamodb._delete_table({"TableName": "gap"})
        sqs._queues.clear()


class Cloud:
    def __init__(self, monkeypatch, streams):
        self.streams, self.mappings, self.seen = streams, StreamMappings(streams), []
        self.mapping = "gap-mapping", dynamodb._tables["gap"]["LatestStreamArn"]
        self.answer = lambda _numbers: {"body": None}
        self.running = self.most = 0
        self._lock = threading.Lock()
        monkeypatch.setattr(lambda_svc, "_execute_function", self._execute)

    def _execute(self, _function, event):
        numbers = [int(record["dynamodb"]["Keys"]["t"]["N"]) for record in event["Records"]]
        with self._lock:
            self.running += 1
            self.most = max(self.most, self.running)
            self.seen.append(numbers)
        answer = self.answer(numbers)
        with self._lock:
            self.running -= 1
        return answer

    def put(self, *numbers):
        for n in numbers:
            item = {"topic": {"S": "a"}, "t": {"N": str(n)}, "at": {"N": str(time.monotonic_ns())}}
            assert dynamodb._put_item({"TableName": "gap", "Item": item})[0] == 200

    def poll_until(self, condition):
        deadline = time.monotonic() + GUARD_S
        while not condition():
            assert time.monotonic() < deadline, self.seen
            if not self.mappings.poll():
                # Wait as the poller's own thread does: until an invocation or a pause ends.
                lambda_svc._esm_wake.wait(0.05)

    @property
    def told(self):
        queue = sqs._queue_by_arn(QUEUE_ARN)
        return [json.loads(message["body"]) for message in queue["messages"]]


def test_records_arrive_in_order_and_in_batches(cloud):
    cloud.put(*range(10))
    cloud.poll_until(lambda: sum(map(len, cloud.seen)) == 10)
    assert cloud.seen == [[0, 1, 2, 3], [4, 5, 6, 7], [8, 9]]
    assert cloud.most == 1
    cloud.put(10)
    cloud.poll_until(lambda: cloud.seen[-1] == [10])
    assert cloud.told == []


def test_only_the_failing_record_goes_to_the_destination(cloud):
    cloud.answer = lambda numbers: {"error": 2 in numbers, "body": None}
    cloud.put(*range(5))
    cloud.poll_until(lambda: [4] in cloud.seen)
    assert cloud.seen == [[0, 1, 2, 3], [0, 1], [2, 3], [2], [2], [3], [4]]
    (message,) = cloud.told
    assert message["requestContext"]["condition"] == "RetryAttemptsExhausted"
    info = message["DDBStreamBatchInfo"]
    assert (info["batchSize"], info["startSequenceNumber"]) == (1, info["endSequenceNumber"])


def test_a_destination_is_told_again_if_its_message_is_undone(cloud, monkeypatch):
    monkeypatch.setattr(sqs, "_queues", sqs._queues)
    ledger, send = cloud.streams.ledger, lambda_svc._send_ddb_stream_failure_record
    queues.install(ledger)
    sqs._act_create_queue({"QueueName": "gap-destination"}, "")
    undone = []

    def send_and_undo(*arguments):
        send(*arguments)
        if not undone:
            undone.append(cloud.told)
            with suppress(LedgerError), ledger.write() as connection:
                connection.execute("INSERT INTO nowhere VALUES (1)")

    monkeypatch.setattr(lambda_svc, "_send_ddb_stream_failure_record", send_and_undo)
    cloud.answer = lambda numbers: {"error": 2 in numbers, "body": None}
    cloud.put(*range(5))
    ledger.commit()
    cloud.poll_until(lambda: [4] in cloud.seen and cloud.streams.position(*cloud.mapping) == 5)
    assert (len(undone[0]), len(cloud.told)) == (1, 1)
    assert ledger.read_committed("SELECT count(*) FROM messages") == [(1,)]


def test_the_poller_wakes_at_the_end_of_the_window(cloud):
    lambda_svc._esms["gap-mapping"]["MaximumBatchingWindowInSeconds"] = 1
    cloud.put(0)
    lambda_svc._esm_wake.clear()
    assert not cloud.mappings.poll()
    assert lambda_svc._esm_wake.wait(GUARD_S)
    cloud.poll_until(lambda: cloud.seen)
    assert cloud.seen == [[0]]


def test_a_mapping_goes_on_after_a_restart_with_what_it_had_not_finished(cloud):
    cloud.answer = lambda numbers: {"error": 6 in numbers, "body": None}
    lambda_svc._esms["gap-mapping"]["MaximumRetryAttempts"] = -1
    cloud.put(*range(8))
    cloud.poll_until(lambda: cloud.seen.count([6]) > 1)
    cloud.seen.clear()
    # A new poller knows what the ledger has.
    cloud.answer = lambda _numbers: {"body": None}
    cloud.mappings = StreamMappings(cloud.streams)
    cloud.poll_until(lambda: cloud.seen and cloud.seen[-1][-1] == 7)
    assert cloud.seen == [[6, 7]]


def test_records_do_not_age_while_the_emulator_is_off(cloud):
    lambda_svc._esms["gap-mapping"]["MaximumRecordAgeInSeconds"] = 60
    cloud.put(0)
    now = time.time() + 3600
    cloud.mappings = StreamMappings(cloud.streams, lambda: now)
    cloud.poll_until(lambda: cloud.seen)
    assert (cloud.seen, cloud.told) == ([[0]], [])


def test_a_new_mapping_of_the_latest_records_misses_none_in_a_restart(cloud):
    lambda_svc._esms["gap-mapping"]["StartingPosition"] = "LATEST"
    cloud.put(0)
    assert not cloud.mappings.poll()
    cloud.put(1)
    cloud.mappings = StreamMappings(cloud.streams)
    cloud.poll_until(lambda: cloud.seen)
    assert cloud.seen == [[1]]
