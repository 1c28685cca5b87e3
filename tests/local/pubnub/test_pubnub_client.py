"""The live function's publisher: PubNub's own SDK against the stand-in, over a real connection."""

from __future__ import annotations

import http.server
import json
import logging
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from functions.shared import pubnub_client
from functions.shared.pubnub_client import PublishError, PubNubPublisher
from iort_contract.limits import MAX_PUBNUB_BYTES
from local.pubnub import PubNubStandIn
from testkit.ports import free_port
from testkit.waiting import GUARD_S

KEYS = {"publish_key": "pub-c-ours", "subscribe_key": "sub-c-ours"}
MESSAGE = {"robot": "car", "sample": {"speed": 1200, "text": 'a "quoted" ä'}}


@pytest.fixture
def standin():
    with PubNubStandIn(**KEYS) as standin:
        yield standin


@pytest.fixture(autouse=True)
def patient(monkeypatch):
    """On a slow machine the stand-in does not always answer within Lambda 1's second."""
    monkeypatch.setattr(pubnub_client, "_TIMEOUT_S", int(GUARD_S))


@pytest.fixture
def publisher():
    """Make publishers; close each at the end."""
    made = []

    def make(origin, **keys):
        made.append(PubNubPublisher(**{**KEYS, **keys}, origin=origin, tls=False))
        return made[-1]

    yield make
    for one in made:
        one._client._request_handler.close()


@pytest.fixture(autouse=True)
def quiet(caplog):
    """Check that neither an error nor a log line shows a key, at any log level."""
    with caplog.at_level(logging.DEBUG):
        yield
    for record in caplog.get_records("call"):
        assert "c-ours" not in record.getMessage(), record.name


def received(standin):
    return [message for _, message in standin._history.after(0, Everything())]


class Everything:
    def match(self, channel):
        return channel


def refused(publisher):
    """Return the error of a publish."""
    with pytest.raises(PublishError) as caught:
        publisher.publish("iort.car", MESSAGE)
    assert "c-ours" not in str(caught.value)
    return str(caught.value)


def test_a_publish_arrives(standin, publisher):
    publisher(standin.origin).publish("iort.car", MESSAGE)
    (message,) = received(standin)
    assert (message.channel, message.publisher) == ("iort.car", "iort-live")
    assert json.loads(message.payload) == MESSAGE
    assert (standin.published, standin.refused) == (1, 0)


def test_publishes_share_one_connection(standin, publisher, monkeypatch):
    accepted = []
    connect = socket.socket.connect
    monkeypatch.setattr(socket.socket, "connect", lambda *a: accepted.append(a) or connect(*a))
    one = publisher(standin.origin)
    for _ in range(20):
        one.publish("iort.car", MESSAGE)
    assert standin.published == 20
    assert len(accepted) == 1


def test_a_too_large_message_is_rejected_by_the_client_or_the_server(standin, publisher):
    one = publisher(standin.origin)
    with pytest.raises(PublishError, match="bytes after URL encoding"):
        one.publish("iort.car", {"text": "x" * MAX_PUBNUB_BYTES})
    assert standin.refused == 0
    # PubNub counts the channel and its own overhead, too: this message passes here and is rejected there.
    just = MAX_PUBNUB_BYTES - len("%7B%22text%22%3A%22%22%7D")
    with pytest.raises(PublishError, match="status 413"):
        one.publish("iort.car", {"text": "x" * just})
    one.publish("iort.car", {"text": "x" * (just - 200)})
    assert (standin.published, standin.refused) == (1, 1)


def test_rejected_keys_are_not_shown(standin, publisher):
    text = refused(publisher(standin.origin, publish_key="other-c-ours"))
    assert text == "PubNubException, status 400"


def test_a_publish_fails_without_a_server_and_recovers_with_it(publisher):
    port = free_port()
    with PubNubStandIn(port=port, **KEYS) as standin:
        one = publisher(standin.origin)
        one.publish("iort.car", MESSAGE)
    for _ in range(2):
        assert refused(one).startswith("PubNubException")
    with PubNubStandIn(port=port, **KEYS) as standin:
        one.publish("iort.car", MESSAGE)
        assert standin.published == 1


def test_a_publish_to_a_silent_server_times_out(publisher, monkeypatch):
    monkeypatch.setattr(pubnub_client, "_TIMEOUT_S", 1)
    with socket.create_server(("127.0.0.1", 0)) as silent:
        one = publisher(f"127.0.0.1:{silent.getsockname()[1]}")
        assert refused(one).startswith("PubNubException")


@contextmanager
def answering(status: int, body: bytes) -> Iterator[str]:
    """A server other than PubNub: a proxy's login page, a gateway's error. It answers once a connection."""

    class Handler(http.server.BaseHTTPRequestHandler):
        protocol_version = "HTTP/1.1"
        answered = False

        def do_POST(self):
            if self.answered:
                self.close_connection = True
                return
            self.answered = True
            self.rfile.read(int(self.headers["Content-Length"]))
            self.send_response(status)
            self.send_header("Content-Length", str(len(body)))
            self.end_headers()
            self.wfile.write(body)

        def log_message(self, *_arguments):
            pass

    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), Handler) as server:
        thread = threading.Thread(target=server.serve_forever, daemon=True)
        thread.start()
        yield f"127.0.0.1:{server.server_address[1]}"
        server.shutdown()
        thread.join()


@pytest.mark.parametrize(
    ("status", "body"),
    [
        (200, b"<html>Sign in</html>"),
        (200, b""),
        (200, b"{}"),
        (200, b"[1]"),
        (500, b"<html>Bad gateway: pub-c-ours</html>"),
        (403, b'{"message": "sub-c-ours", "error": true}'),
        (400, b'[0, "Invalid Key pub-c-ours", "0"]'),
        (429, b""),
    ],
)
def test_an_answer_without_confirmation_raises_a_publish_error(publisher, status, body):
    with answering(status, body) as origin:
        refused(publisher(origin))


def test_a_publish_after_a_pause_uses_no_connection_that_may_have_ended(publisher, monkeypatch):
    with answering(200, b'[1,"Sent","17000000000000000"]') as origin:
        one = publisher(origin)
        one.publish("iort.car", MESSAGE)
        now_s = time.time()
        monkeypatch.setattr(time, "time", lambda: now_s + 10)
        one.publish("iort.car", MESSAGE)
