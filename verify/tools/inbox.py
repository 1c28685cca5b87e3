"""Receives a topic's messages by a temporary queue, since a mail needs a person."""

from __future__ import annotations

import json
import uuid
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from testkit.target import Target
from testkit.waiting import until

_PROBE = "verify: does this arrive?"
Message = dict[str, Any]
# Returns the first message that matches. Raises `InstrumentError` if none arrives in time.
Receive = Callable[[Callable[[Message], bool], str], Message]


@contextmanager
def inbox(target: Target, topic: str) -> Iterator[Receive]:
    """A queue subscribed to the topic; subscription and queue are removed at the end."""
    sqs, sns = target.cloud.client("sqs"), target.cloud.client("sns")
    # SQS refuses a name for 60 s after its queue was deleted.
    name = f"{target.cloud.namespace}-verify-{uuid.uuid4().hex[:8]}"
    url = sqs.create_queue(QueueName=name)["QueueUrl"]
    try:
        arn = sqs.get_queue_attributes(QueueUrl=url, AttributeNames=["QueueArn"])["Attributes"]["QueueArn"]
        sqs.set_queue_attributes(QueueUrl=url, Attributes={"Policy": _policy(arn, topic)})
        subscription = sns.subscribe(TopicArn=topic, Protocol="sqs", Endpoint=arn)["SubscriptionArn"]
        try:
            # A queue's policy may take 60 s to become effective, and earlier messages are lost.
            until(lambda: _probed(sns, topic, sqs, url), "a message of the topic at its new subscriber")
            yield lambda wanted, what: until(lambda: _received(sqs, url, wanted), what)
        finally:
            sns.unsubscribe(SubscriptionArn=subscription)
    finally:
        sqs.delete_queue(QueueUrl=url)


def _policy(arn: str, topic: str) -> str:
    statement = {
        "Effect": "Allow",
        "Principal": {"Service": "sns.amazonaws.com"},
        "Action": "sqs:SendMessage",
        "Resource": arn,
        "Condition": {"ArnEquals": {"aws:SourceArn": topic}},
    }
    return json.dumps({"Version": "2012-10-17", "Statement": [statement]})


def _probed(sns: Any, topic: str, sqs: Any, url: str) -> Message | None:
    sns.publish(TopicArn=topic, Message=_PROBE)
    return _received(sqs, url, lambda message: message["Message"] == _PROBE)


def _received(sqs: Any, url: str, wanted: Callable[[Message], bool]) -> Message | None:
    answer = sqs.receive_message(QueueUrl=url, MaxNumberOfMessages=10, WaitTimeSeconds=5)
    bodies = [json.loads(message["Body"]) for message in answer.get("Messages", [])]
    return next(filter(wanted, bodies), None)
