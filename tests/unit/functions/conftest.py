"""What a function has around it in Lambda: its context, the quarantine's queue, and AWS IoT's broker."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from functions.quarantine import entries
from testkit.dynamodb import ARCHIVE, FILES, FINDINGS, QUARANTINE, ROBOTS, SUMMARY, TELEMETRY


@pytest.fixture(autouse=True)
def variables_of_functions(monkeypatch):
    """What the environment of every function says; a test adds what only its own has."""
    tables = (TELEMETRY, SUMMARY, ROBOTS, ARCHIVE, FINDINGS, QUARANTINE)
    for name, value in {f"{table}_table".upper(): table for table in tables}.items():
        monkeypatch.setenv(name, value)
    monkeypatch.setenv("FILES_BUCKET", FILES)
    monkeypatch.setenv("REJECTED_QUEUE", "https://sqs.eu-west-1.amazonaws.com/0/none")


@pytest.fixture
def invoke():
    """Call a handler as Lambda does."""

    def call(handler, event):
        name = handler.__module__.rpartition(".")[2]
        arn = f"arn:aws:lambda:eu-west-1:000000000000:function:{name}"
        return handler(event, SimpleNamespace(invoked_function_arn=arn))

    return call


@pytest.fixture
def rejected(aws, monkeypatch):
    """The quarantine's queue: what was sent there since the last look."""
    import boto3

    sqs = boto3.client("sqs")
    url = sqs.create_queue(QueueName="rejected")["QueueUrl"]
    monkeypatch.setenv("REJECTED_QUEUE", url)

    def taken():
        messages = sqs.receive_message(QueueUrl=url, MaxNumberOfMessages=10).get("Messages", [])
        return [entry for message in messages for entry in entries(message["Body"], list)]

    return taken


@pytest.fixture
def published(aws):
    """The topics and payloads that functions have published."""
    from moto.backends import get_backend
    from moto.core import DEFAULT_ACCOUNT_ID

    return lambda: get_backend("iot-data")[DEFAULT_ACCOUNT_ID]["eu-west-1"].published_payloads
