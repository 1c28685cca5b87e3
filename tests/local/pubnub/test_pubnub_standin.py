"""The stand-in for PubNub, tested with PubNub's own SDKs."""

from __future__ import annotations

import gzip
import http.client
import itertools
import json
import queue
import socket
import threading
import time
from urllib.parse import quote

import pytest
from pubnub.enums import PNReconnectionPolicy
from pubnub.exceptions import PubNubException
from pubnub.pnconfiguration import PNConfiguration
from pubnub.pubnub import PubNub, SubscribeListener

from iort_contract.limits import MAX_PUBNUB_BYTES
from iort_station.page.pubnub import Listener
from local import pubnub as server
from local.pubnub import PubNubStandIn
from testkit.ports import free_port
from testkit.waiting import GUARD_S as WAIT_S


def sdk(standin, *, publish_key="pub", subscribe_key="sub", uuid="car"):
    """Make a client of the real SDK; stop it before the server stops."""
    configuration = PNConfiguration()
    configuration.publish_key, configuration.subscribe_key = publish_key, subscribe_key
    configuration.uuid, configuration.origin, configuration.ssl = uuid, standin.origin, False
    configuration.daemon, configuration.disable_config_locking = True, False
    configuration.reconnect_policy = PNReconnectionPolicy.LINEAR
    configuration.reconnection_interval = 0.1
    return PubNub(configuration)


def publish(pubnub, channel, message, *, post=False):
    return pubnub.publish().channel(channel).message(message).use_post(post).sync()


def ask(standin, path, method="GET", body=None, headers=None):
    connection = http.client.HTTPConnection(standin.host, standin.port, timeout=WAIT_S)
    try:
        connection.request(method, path, body, headers or {})
        response = connection.getresponse()
        return response, response.read().decode()
    finally:
        connection.close()


def poll(standin, channels, token, **arguments):
    response, body = ask(standin, f"/v2/subscribe/sub/{channels}/0?tt={token}&uuid=raw", **arguments)
    assert response.status == 200, body
    answer = json.loads(body)
    return answer["t"]["t"], answer["m"]


PAYLOADS = [
    {"v": 1, "sample": {"speed": 1.5, "fault_code": 0, "note": None, "ok": True}},
    {"text": "Grüße, 世界, 🚗 \u2028 \u0000"},
    {"html": "<script>alert('&amp;')</script> \"quoted\" \\ / ?a=b&c=d#e %2F %"},
    [1, [2.5, -0.1], 2**63, 1e308],
    "text, with/slash",
    0,
    False,
]


@pytest.fixture
def standin():
    """PubNub's stand-in, with keys."""
    with PubNubStandIn(publish_key="pub", subscribe_key="sub") as standin:
        yield standin


@pytest.fixture
def client():
    """Make PubNub SDK clients by `client(standin, uuid="page")`; stop them before the server stops."""
    made = []

    def make(standin, **given):
        made.append(sdk(standin, **given))
        return made[-1]

    yield make
    for pubnub in made:
        pubnub.stop()


def subscribe(pubnub, *channels):
    listener = SubscribeListener()
    pubnub.add_listener(listener)
    pubnub.subscribe().channels(list(channels)).execute()
    assert listener.connected_event.wait(WAIT_S), "the SDK never connected"
    return listener.message_queue


@pytest.mark.parametrize("post", [False, True], ids=["GET", "POST"])
def test_the_sdk_receives_its_published_messages(standin, client, post):
    received, publisher = subscribe(client(standin, uuid="page"), "iort.car"), client(standin)
    for payload in PAYLOADS:
        result = publish(publisher, "iort.car", payload, post=post).result
        event = received.get(timeout=WAIT_S)
        assert (event.message, type(event.message)) == (payload, type(payload))
        assert (event.channel, event.subscription, event.publisher) == ("iort.car", None, "car")
        assert event.timetoken == result.timetoken
        assert len(str(result.timetoken)) == 17
    count = len(PAYLOADS)
    assert (standin.published, standin.delivered, standin.refused) == (count, count, 0)


def test_a_message_arrives_once_with_its_channel_and_the_entry_that_matches(standin, client):
    received, publisher = subscribe(client(standin), "iort.*", "iort.car", "else"), client(standin)
    # The first two are not for us.
    for channel in ("other.car", "iort", "iort.car", "else", "iort.two"):
        publish(publisher, channel, channel)
    events = [received.get(timeout=WAIT_S) for _ in range(3)]
    assert [(e.channel, e.message, e.subscription) for e in events] == [
        ("iort.car", "iort.car", None),
        ("else", "else", None),
        ("iort.two", "iort.two", "iort.*"),
    ]


def test_200_messages_arrive_in_order_over_repeated_polls(client):
    with PubNubStandIn(poll_s=0.01) as standin:
        received, publisher = subscribe(client(standin), "iort.*"), client(standin)
        for number in range(200):
            publish(publisher, "iort.car", number)
        assert [received.get(timeout=WAIT_S).message for _ in range(200)] == list(range(200))
        assert received.empty()


def test_200_messages_arrive_in_order_over_abandoned_polls(standin, client):
    token, _ = poll(standin, "iort.*", 0)
    publisher = client(standin)

    def publish_all():
        for number in range(200):
            publish(publisher, f"iort.car-{number % 3}", number)

    thread = threading.Thread(target=publish_all)
    thread.start()
    numbers = []
    for turn in itertools.count():
        if turn % 2:  # the answer finds a closed connection
            with socket.create_connection((standin.host, standin.port)) as abandoned:
                abandoned.sendall(
                    f"GET /v2/subscribe/sub/iort.*/0?tt={token} HTTP/1.1\r\nHost: x\r\n\r\n".encode()
                )
            continue
        token, messages = poll(standin, "iort.*", token)
        numbers += [message["d"] for message in messages]
        if len(numbers) >= 200:
            break
    thread.join()
    assert numbers == list(range(200))


def test_a_message_has_the_documented_wire_format(standin):
    token, _ = poll(standin, "iort.*", 0)
    response, body = ask(standin, "/publish/pub/sub/0/iort.car/0/%7B%22a%22%3A1%7D?uuid=me")
    assert response.headers["Content-Type"] == "text/javascript; charset=UTF-8"
    flag, text, published = json.loads(body)
    assert (flag, text) == (1, "Sent")
    _, [message] = poll(standin, "iort.*", token)
    assert message == {
        "a": "1",
        "f": 0,
        "i": "me",
        "p": {"t": published, "r": 1},
        "k": "sub",
        "c": "iort.car",
        "b": "iort.*",
        "d": {"a": 1},
    }


def test_an_idle_poll_answers_empty_with_the_same_cursor():
    with PubNubStandIn(poll_s=0.05) as standin:
        token, _ = poll(standin, "iort.car", 0)
        assert poll(standin, "iort.car", token) == (token, [])


def test_a_cursor_from_a_fast_clock_receives_messages(standin, client):
    future, received = "99999999999999999", queue.Queue()
    thread = threading.Thread(target=lambda: received.put(poll(standin, "iort.car", future)[1]))
    thread.start()
    wait_for_polls(standin, 1)
    publish(client(standin), "iort.car", "now")
    thread.join()
    assert [message["d"] for message in received.get()] == ["now"]


def test_timetokens_grow_while_the_clock_stands_still(standin, monkeypatch):
    monkeypatch.setattr(server.time, "time_ns", lambda: 1_700_000_000_000_000_000)
    tokens = [json.loads(ask(standin, "/time/0")[1])[0] for _ in range(3)]
    assert tokens == sorted(set(tokens))


def wait_for_polls(standin, count):
    deadline = time.monotonic() + WAIT_S
    while len(standin._polls) != count:
        assert time.monotonic() < deadline, f"{len(standin._polls)} polls, expected {count}"
        threading.Event().wait(0.002)


def test_two_publishes_in_one_loop_turn_both_arrive(standin):
    token, _ = poll(standin, "iort.car", 0)
    received = queue.Queue()
    thread = threading.Thread(target=lambda: received.put(poll(standin, "iort.car", token)[1]))
    thread.start()
    wait_for_polls(standin, 1)
    connections = [http.client.HTTPConnection(standin.host, standin.port, timeout=WAIT_S) for _ in range(2)]
    for connection in connections:
        connection.request("GET", "/time/0")
        assert connection.getresponse().read()
    gate = threading.Event()
    standin._loop.call_soon_threadsafe(gate.wait)
    for connection in connections:
        connection.request("GET", "/publish/pub/sub/0/iort.car/0/1")
    gate.set()
    assert [connection.getresponse().status for connection in connections] == [200, 200]
    for connection in connections:
        connection.close()
    thread.join()
    assert [message["d"] for message in received.get()] == [1, 1]


def test_a_subscriber_that_leaves_is_removed(standin):
    token, _ = poll(standin, "iort.car", 0)
    with socket.create_connection((standin.host, standin.port)) as gone:
        gone.sendall(f"GET /v2/subscribe/sub/iort.car/0?tt={token} HTTP/1.1\r\nHost: x\r\n\r\n".encode())
        wait_for_polls(standin, 1)
    wait_for_polls(standin, 0)


@pytest.mark.parametrize(
    "path",
    [
        "/v2/presence/sub-key/sub/channel/iort.*/heartbeat?uuid=page",
        "/v2/presence/sub-key/sub/channel/iort.*/leave?uuid=page",
        "/v2/subscribe/sub/,/0?tt=0&channel-group=fleet",
        "/time/0",
    ],
)
def test_other_requests_of_the_sdks_are_answered_to_every_page(standin, path):
    response, _ = ask(standin, path)
    assert (response.status, response.headers["Access-Control-Allow-Origin"]) == (200, "*")
    assert ask(standin, "/nowhere")[0].headers["Access-Control-Allow-Origin"] == "*"


def test_a_browser_preflight_is_answered(standin):
    response, body = ask(
        standin,
        "/publish/pub/sub/0/iort.car/0",
        "OPTIONS",
        headers={
            "Origin": "http://192.168.0.7:8000",
            "Access-Control-Request-Method": "POST",
            "Access-Control-Request-Headers": "content-type",
            "Access-Control-Request-Private-Network": "true",
        },
    )
    assert (response.status, body) == (204, "")
    assert response.headers["Access-Control-Allow-Origin"] == "*"
    assert "POST" in response.headers["Access-Control-Allow-Methods"]
    assert response.headers["Access-Control-Allow-Headers"] == "content-type"
    assert response.headers["Access-Control-Allow-Private-Network"] == "true"


def test_the_sdk_continues_with_a_restarted_server(client):
    with PubNubStandIn(port=free_port()) as standin:
        received = subscribe(client(standin), "iort.*")
        publish(client(standin), "iort.car", "before")
        assert received.get(timeout=WAIT_S).message == "before"
        wait_for_polls(standin, 1)
        standin.stop()  # with an open poll, which takes minutes to end
    # The SDK may be back or not: its cursor is older than the message.
    with PubNubStandIn(port=standin.port) as restarted:
        publish(client(restarted), "iort.car", "after")
        assert received.get(timeout=WAIT_S).message == "after"


def test_channel_names_are_unquoted(standin):
    token, _ = poll(standin, quote("grün.*"), 0)
    ask(standin, f"/publish/pub/sub/0/{quote('grün.1')}/0/1")
    _, [received] = poll(standin, quote("grün.*"), token)
    assert (received["c"], received["b"]) == ("grün.1", "grün.*")


def test_a_listener_that_stopped_polls_no_more(standin):
    """The SDK may begin its next poll while it stops."""
    with Listener(subscribe_key="sub", robot="car1", origin=standin.origin, tls=False) as listener:
        pass
    session = listener._client.get_request_handler()._ensure_session()
    assert session.is_closed


# Requests that it rejects, in PubNub's own words.


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


def test_a_wrong_key_is_rejected(standin, client):
    for keys in ({"publish_key": "no"}, {"subscribe_key": "no"}):
        with pytest.raises(PubNubException) as caught:
            publish(client(standin, **keys), "iort.car", 1)
        assert caught.value._status_code == 400
        assert json.loads(caught.value._errormsg)[:2] == [0, "Invalid Key"]
    for path, service in (
        ("/v2/subscribe/no/iort.car/0", "Access Manager"),
        ("/v2/presence/sub-key/no/channel/iort.car/heartbeat", "Presence"),
    ):
        response, body = ask(standin, path)
        told = {"status": 400, "service": service, "error": True, "message": "Invalid Key"}
        assert (response.status, json.loads(body)) == (400, told)


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
