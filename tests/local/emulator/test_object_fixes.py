"""Objects end by the lifecycle rules that a template gives to their bucket."""

from __future__ import annotations

import json
import ssl
import threading
import time
import urllib.error
import urllib.request
from collections import Counter

import pytest
from ministack.core.responses import request_scope
from ministack.services import lambda_svc, s3, sqs
from ministack.services.cloudformation import provisioners

from local.emulator.fixes import alarms, storage
from testkit.waiting import GUARD_S

DAY_S = 86_400
RULES = [
    {"Status": "Enabled", "Id": "old", "Prefix": "results/", "ExpirationInDays": 1},
    {"Status": "Disabled", "Prefix": "kept/", "ExpirationInDays": 1},
    {"Status": "Enabled", "AbortIncompleteMultipartUpload": {"DaysAfterInitiation": 2}},
]


@pytest.fixture
def bucket(monkeypatch):
    monkeypatch.setattr(provisioners, "_S3_BUCKET_CONFIGURATIONS", provisioners._S3_BUCKET_CONFIGURATIONS)
    monkeypatch.setattr(alarms, "BEFORE_ALARMS", [])
    storage.close_object_expiry()
    with request_scope("000000000000", "eu-west-1"):
        properties = {"BucketName": "expiring", "LifecycleConfiguration": {"Rules": RULES}}
        yield provisioners._s3_create("Bucket", properties, "stack")[0]
        s3.reset()


def test_objects_and_abandoned_uploads_end_by_the_rules(bucket):
    for key in ("results/a", "kept/a"):
        s3._put_object(bucket, key, b"bytes", {})
    s3._create_multipart_upload(bucket, "results/b", {})

    def left(days):
        storage.expire(time.time() + days * DAY_S)
        return list(s3._buckets[bucket]["objects"]), len(s3._multipart_uploads)

    assert left(0.9) == (["results/a", "kept/a"], 1)
    assert left(1.1) == (["kept/a"], 1)
    assert left(2.1) == (["kept/a"], 0)


# What a user of this machine gets from the gateway without a signature.


@pytest.mark.parametrize(
    "asked",
    [
        "POST /_ministack/reset",
        "POST /_ministack/config",
        "GET /_ministack/sqs/messages",
        "GET /_ministack/lambda-code/live",
        "GET /_localstack/health",
    ],
)
def test_nobody_erases_or_reads_a_cloud_without_a_signature(embedded, asked):
    method, path = asked.split()
    request = urllib.request.Request(f"{embedded.cloud.endpoint_url}{path}", method=method)
    context = ssl.create_default_context(cafile=embedded.cloud.ca_bundle)
    with pytest.raises(urllib.error.HTTPError, match="403"):
        urllib.request.urlopen(request, context=context, timeout=GUARD_S)


# Each of ten thousand messages arrives once, with concurrent senders, sweeps, receivers and deletions.

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
