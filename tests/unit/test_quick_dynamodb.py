"""The quick client's requests are those that botocore's own would have made."""

from __future__ import annotations

import json

import boto3
from botocore.awsrequest import AWSResponse

from functions import quick_dynamodb
from tests.fakes import SUMMARY

ITEMS = [
    {
        "topic": {"S": "dt/iort/car/vesc"},
        "second": {"N": str(second)},
        "speed": {"L": [{"N": "1.5"}, {"N": "2"}]},
    }
    | {"mode_last": {"S": 'gr\u00fc\u00df "dich"'}, "on_last": {"BOOL": True}, "odd_last": {"NULL": True}}
    for second in range(3)
]
REQUEST = {SUMMARY: [{"PutRequest": {"Item": item}} for item in ITEMS]}


class Answer:
    """What the service sent back."""

    def stream(self, **_kwargs):
        yield b"{}"


def sent(client):
    """The client's requests of a write and a read, which get no further."""
    requests = []

    def answer(request, **_kwargs):
        requests.append(request)
        return AWSResponse(request.url, 200, {}, Answer())

    client.meta.events.register_first("before-send.dynamodb", answer)
    client.batch_write_item(RequestItems=REQUEST)
    client.get_item(TableName=SUMMARY, Key={"topic": {"S": "a"}, "second": {"N": "1"}})
    return requests


def test_its_requests_are_botocores_own(aws):
    plain, quick = sent(boto3.client("dynamodb")), sent(quick_dynamodb.client())
    assert len(quick) == 2
    for theirs, ours in zip(plain, quick, strict=True):
        assert json.loads(ours.body) == json.loads(theirs.body)
        assert (ours.url, ours.headers["X-Amz-Target"]) == (theirs.url, theirs.headers["X-Amz-Target"])


def test_items_are_stored_as_they_were_given(dynamodb):
    client = quick_dynamodb.client()
    assert client.batch_write_item(RequestItems=REQUEST)["UnprocessedItems"] == {}
    stored = client.scan(TableName=SUMMARY)["Items"]
    assert sorted(stored, key=lambda item: item["second"]["N"]) == ITEMS
