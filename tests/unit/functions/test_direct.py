"""Requests of `summarize` that go to DynamoDB without botocore, and those that it has to send."""

from __future__ import annotations

import json
import time
import zlib
from types import SimpleNamespace

import pytest
from botocore.auth import SigV4Auth
from botocore.awsrequest import AWSRequest
from botocore.credentials import Credentials

from functions.shared import direct
from functions.shared.direct import Direct

ITEMS = {"Items": [{"topic": {"S": "a"}}], "Count": 1}
BY_BOTOCORE = {"by": "botocore"}
REQUEST = {"TableName": "t", "ExpressionAttributeValues": {":topic": {"S": "a"}}}


class Connection:
    """A connection that answers, or fails, as the test says."""

    made: list[Connection]
    answers: list[object]

    def __init__(self, host, **_):
        self.host, self.closed = host, False
        self.requests = []
        self.made.append(self)

    def request(self, method, path, body, headers):
        self.requests.append((method, path, body, dict(headers)))

    def getresponse(self):
        answer = self.answers.pop(0)
        if isinstance(answer, Exception):
            raise answer
        status, text, *crc = answer
        headers = {"x-amz-crc32": str(*crc or (zlib.crc32(text),))}
        return SimpleNamespace(status=status, headers=headers, read=lambda: text)

    def close(self):
        self.closed = True


def answered(content=ITEMS, status=200):
    return status, json.dumps(content).encode()


@pytest.fixture
def connections(monkeypatch):
    Connection.made, Connection.answers = [], []
    monkeypatch.setattr(direct.http.client, "HTTPSConnection", Connection)
    monkeypatch.setattr(time, "gmtime", lambda: time.struct_time((2025, 6, 15, 15, 6, 40, 6, 166, 0)))
    return Connection


@pytest.fixture
def client(connections):
    meta = SimpleNamespace(endpoint_url="https://dynamodb.eu-west-1.amazonaws.com", region_name="eu-west-1")
    botocores = SimpleNamespace(
        meta=meta,
        query=lambda **_: BY_BOTOCORE,
        batch_write_item=lambda **_: BY_BOTOCORE,
        get_item=lambda **_: BY_BOTOCORE,
    )
    return Direct(botocores, Credentials("AKID", "secret", "token"))


@pytest.mark.parametrize(
    ("answers", "expected", "connected"),
    [
        ([answered()], ITEMS, 1),
        ([answered({})], {}, 1),
        ([answered({"message": "slow down"}, 400)], BY_BOTOCORE, 1),
        ([answered(status=500)], BY_BOTOCORE, 1),
        ([answered({"Items": [{"samples": {"B": "AA=="}}]})], BY_BOTOCORE, 1),
        ([(200, b'{"Items": []}', 7)], BY_BOTOCORE, 1),
        ([ConnectionRefusedError()], BY_BOTOCORE, 1),
        ([direct.http.client.IncompleteRead(b"")], BY_BOTOCORE, 1),
    ],
)
def test_whatever_is_no_plain_answer_goes_through_botocore(client, connections, answers, expected, connected):
    connections.answers = answers
    assert client.query(**REQUEST) == expected
    assert len(connections.made) == connected


def test_a_connection_is_kept_until_the_service_closes_it(client, connections):
    connections.answers = [answered(), answered(), ConnectionResetError(), answered()]
    assert [client.query(**REQUEST) for _ in range(3)] == [ITEMS] * 3
    first, second = connections.made
    assert (len(first.requests), len(second.requests)) == (3, 1)
    assert (first.closed, second.closed) == (True, False)


def test_a_write_goes_the_same_way_and_bytes_do_not(client, connections):
    connections.answers = [answered({"UnprocessedItems": {}})]
    written = {"RequestItems": {"t": [{"PutRequest": {"Item": {"n": {"N": "1"}}}}]}}
    assert client.batch_write_item(**written) == {"UnprocessedItems": {}}
    ((method, path, body, headers),) = connections.made[0].requests
    assert (method, path, json.loads(body)) == ("POST", "/", written)
    assert headers["x-amz-target"] == "DynamoDB_20120810.BatchWriteItem"
    with_bytes = {"RequestItems": {"t": [{"PutRequest": {"Item": {"n": {"B": b"1"}}}}]}}
    assert client.batch_write_item(**with_bytes) == client.get_item() == BY_BOTOCORE
    assert len(connections.made[0].requests) == 1


@pytest.mark.parametrize("given", [("AKID", "secret", "token"), ("AKID2", "other", None)])
def test_a_request_is_signed_as_botocore_signs_it(client, connections, given):
    """Also after the credentials changed."""
    connections.answers = [answered(), answered()]
    client.query(**REQUEST)
    client._credentials = Credentials(*given)
    client.query(**REQUEST)
    _, (method, _, body, headers) = connections.made[0].requests
    signed = {name: value for name, value in headers.items() if name not in {"authorization", "host"}}
    request = AWSRequest(method, client.meta.endpoint_url + "/", headers=signed, data=body)
    request.context["timestamp"] = headers["x-amz-date"]
    auth = SigV4Auth(client._credentials, "dynamodb", "eu-west-1")
    signature = auth.signature(auth.string_to_sign(request, auth.canonical_request(request)), request)
    assert headers["authorization"].endswith(f"Signature={signature}")
    assert f"Credential={given[0]}/20250615/eu-west-1/dynamodb/aws4_request" in headers["authorization"]
    assert headers.get("x-amz-security-token") == given[2]
