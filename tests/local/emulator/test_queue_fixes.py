"""Each of ten thousand messages arrives once, with concurrent senders, sweeps, receivers and deletions."""

from __future__ import annotations

import inspect
import json
import threading
from collections import Counter

import pytest
from ministack.core.responses import request_scope
from ministack.services import lambda_svc, sqs

ACCOUNT, REGION = "000000000000", "eu-west-1"
MESSAGES, SENDERS = 10_000, 4
ARN = f"arn:aws:sqs:{REGION}:{ACCOUNT}:"


@pytest.fixture
def queue():
    """Create a queue with a dead-letter queue in ministack; return its URL."""
    with request_scope(ACCOUNT, REGION):
        sqs._act_create_queue({"QueueName": "gap-last"}, "")
        redrive = json.dumps({"maxReceiveCount": 5, "deadLetterTargetArn": f"{ARN}gap-last"})
        attributes = {"RedrivePolicy": redrive, "VisibilityTimeout": "600"}
        url = sqs._act_create_queue({"QueueName": "gap", "Attributes": attributes}, "")["QueueUrl"]
        yield url
        sqs._queues.clear()


def drive(url, messages=MESSAGES):
    """Send from several threads, as rules and destinations do, and receive in others, as the mapping and
    an operator do; return how often each message came.
    """
    came, sent = Counter(), threading.Event()

    def scoped(work, *arguments):
        with request_scope(ACCOUNT, REGION):
            work(*arguments)

    def send(first):
        for n in range(first, messages, SENDERS):
            if first % 2:
                sqs._HANDLERS["SendMessage"]({"MessageBody": json.dumps({"requestPayload": n})}, url)
            else:
                lambda_svc._route_async_failure(f"{ARN}gap", "function", n, {"error": True})

    def receive():
        while True:
            # Read this before the look into the queue: afterwards no message can follow.
            over = sent.is_set()
            batch = sqs._receive_messages_for_esm(url, 10)
            came.update(json.loads(message["body"])["requestPayload"] for message in batch)
            sqs._delete_messages_for_esm(url, {message["receipt_handle"] for message in batch})
            if over and not batch:
                return

    senders = [threading.Thread(target=scoped, args=(send, n)) for n in range(SENDERS)]
    receiver = threading.Thread(target=scoped, args=(receive,))
    for thread in (*senders, receiver):
        thread.start()
    for thread in senders:
        thread.join()
    sent.set()
    receiver.join()
    return came


def test_each_of_ten_thousand_messages_arrives_once(queue):
    came = drive(queue)
    assert len(came) == MESSAGES
    assert set(came.values()) == {1}
    assert sqs._get_q(queue)["messages"] == []


def test_every_function_that_changes_a_queue_takes_the_lock():
    """Checks the calls that add and remove this project's messages."""
    changing = {
        name: function
        for name, function in inspect.getmembers(sqs, inspect.isfunction)
        if '["messages"]' in (source := inspect.getsource(function))
        and any(word in source for word in ('["messages"] =', '["messages"].', '["visible_at"] ='))
    }
    # `_collect_msgs` calls it.
    del changing["_collect_fifo"]
    assert len(changing) > 8
    for name, function in changing.items():
        source = inspect.getsource(function)
        assert "@_locked" in source or "with _queues_lock:" in source, name
