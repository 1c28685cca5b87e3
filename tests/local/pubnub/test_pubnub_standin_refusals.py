"""Requests that the stand-in for PubNub rejects, in PubNub's own words."""

from __future__ import annotations

import gzip
import http.client
import json
import socket
import threading

import pytest
from pubnub.exceptions import PubNubException

from iort_contract.limits import MAX_PUBNUB_BYTES
from local.pubnub import PubNubStandIn
from tests.local.pubnub.pubnub_sdk import WAIT_S, ask, poll, publish


@pytest.mark.parametrize(
    ("body", "answer"),
    [
        (gzip.compress(b"1"), [1, "Sent"]),
        (gzip.compress(b"1" * 5_000_000), [0, "Message Too Large"]),
        (b"not gzip", [0, "Invalid Encoding"]),
        (gzip.compress(b"1")[:-4], [0, "Invalid Encoding"]),
        (gzip.compress(b"\xff"), [0, "Invalid Encoding"]),
    ],
    ids=["good", "bomb", "broken", "cut short", "not UTF-8"],
)
def test_a_gzip_body_is_decoded_or_rejected(standin, body, answer):
    _, text = ask(standin, "/publish/pub/sub/0/c/0", "POST", body, {"Content-Encoding": "gzip"})
    assert json.loads(text)[:2] == answer


def test_too_many_polls_are_rejected():
    with PubNubStandIn(max_polls=0) as standin:
        response, _ = ask(standin, "/v2/subscribe/sub/iort.car/0?tt=1")
    assert response.status == 429


def test_a_subscriber_that_does_not_read_is_disconnected():
    cut = threading.Event()

    class Watched(PubNubStandIn):
        async def handle(self, request):
            try:
                return await super().handle(request)
            finally:
                # The first poll, from 0, comes from a client that closes its own connection.
                gone = request.transport is None or request.transport.is_closing()
                if gone and request.query.get("tt", "0") != "0":
                    cut.set()

    with Watched(write_s=0.2) as standin, socket.socket() as slow:
        token, _ = poll(standin, "iort.car", 0)
        publisher = http.client.HTTPConnection(standin.host, standin.port, timeout=WAIT_S)
        for _ in range(100):
            publisher.request("POST", "/publish/pub/sub/0/iort.car/0", json.dumps("x" * 32_000))
            assert publisher.getresponse().read()
        publisher.close()
        slow.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        slow.settimeout(WAIT_S)
        slow.connect((standin.host, standin.port))
        slow.sendall(f"GET /v2/subscribe/sub/iort.car/0?tt={token} HTTP/1.1\r\nHost: x\r\n\r\n".encode())
        assert cut.wait(WAIT_S)
        received = sum(len(chunk) for chunk in iter(lambda: slow.recv(65536), b""))
        assert received < 100 * 32_000


@pytest.mark.parametrize("post", [False, True], ids=["GET", "POST"])
def test_a_too_large_message_is_rejected(standin, client, post):
    pubnub = client(standin)
    room = MAX_PUBNUB_BYTES - 100 - len("c") - 2 * len("%22")
    assert publish(pubnub, "c", "x" * room, post=post).result.timetoken
    with pytest.raises(PubNubException) as caught:
        publish(pubnub, "c", "x" * (room + 1), post=post)
    assert caught.value._status_code == 413
    assert json.loads(caught.value._errormsg)[:2] == [0, "Message Too Large"]
    assert (standin.published, standin.refused) == (1, 1)


def test_a_post_of_megabytes_is_rejected(standin):
    response, body = ask(standin, "/publish/pub/sub/0/c/0", "POST", json.dumps("x" * 3_000_000))
    assert (response.status, json.loads(body)[:2]) == (413, [0, "Message Too Large"])


@pytest.mark.parametrize(
    "keys", [{"publish_key": "no"}, {"subscribe_key": "no"}], ids=["publish", "subscribe"]
)
def test_a_wrong_key_is_rejected(standin, client, keys):
    with pytest.raises(PubNubException) as caught:
        publish(client(standin, **keys), "iort.car", 1)
    assert caught.value._status_code == 400
    assert json.loads(caught.value._errormsg)[:2] == [0, "Invalid Key"]


@pytest.mark.parametrize(
    ("path", "service"),
    [
        ("/v2/subscribe/no/iort.car/0", "Access Manager"),
        ("/v2/presence/sub-key/no/channel/iort.car/heartbeat", "Presence"),
    ],
)
def test_a_subscriber_with_a_wrong_key_is_rejected(standin, path, service):
    response, body = ask(standin, path)
    assert response.status == 400
    assert json.loads(body) == {"status": 400, "service": service, "error": True, "message": "Invalid Key"}


def test_a_server_without_keys_accepts_any_key(client):
    with PubNubStandIn() as standin:
        assert publish(client(standin, publish_key="a", subscribe_key="b"), "iort.car", 1).result.timetoken


@pytest.mark.parametrize(
    ("path", "status", "message"),
    [
        ("/publish/pub/sub/0/iort.car/0/NaN", 400, "Invalid JSON"),
        ("/publish/pub/sub/0/iort.car/0/%7B", 400, "Invalid JSON"),
        ("/publish/pub/sub/0/iort.car/0/" + "[" * 5_000, 400, "Invalid JSON"),
        ("/publish/pub/sub/0/iort.car/0/%FF", 400, "Invalid Encoding"),
        ("/publish/pub/sub/0/iort.*/0/1", 400, "Invalid Channel"),
        ("/publish/pub/sub/0/a%2Cb/0/1", 400, "Invalid Channel"),
        ("/publish/pub/sub/0//0/1", 400, "Invalid Channel"),
        ("/publish/pub/sub/0/iort.car/0/1?meta=%7B%7D", 400, "meta is not supported by the stand-in"),
        ("/v2/subscribe/sub/iort.car/0?tt=x", 400, "Invalid Timetoken"),
        ("/v2/history/sub-key/sub/channel/iort.car", 404, "Not Found"),
        ("/", 404, "Not Found"),
    ],
)
def test_an_invalid_request_is_rejected(standin, path, status, message):
    response, body = ask(standin, path)
    answer = json.loads(body)
    assert (response.status, answer["message"] if isinstance(answer, dict) else answer[1]) == (
        status,
        message,
    )
    assert (standin.published, standin.refused) == (0, 1)


def test_nan_from_the_sdk_is_rejected(standin, client):
    with pytest.raises(PubNubException, match="Invalid JSON"):
        publish(client(standin), "iort.car", {"speed": float("nan")})
