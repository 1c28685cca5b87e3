"""The stand-in for PubNub, tested with PubNub's own SDKs."""

from __future__ import annotations

import http.client
import itertools
import json
import queue
import socket
import threading
import time
from urllib.parse import quote

import pytest
from pubnub.pubnub import SubscribeListener

from iort_station.page.pubnub import Listener
from local import pubnub as server
from local.pubnub import PubNubStandIn
from testkit.ports import free_port
from tests.local.pubnub.pubnub_sdk import PAYLOADS, WAIT_S, ask, poll, publish


def subscribe(pubnub, *channels):
    listener = SubscribeListener()
    pubnub.add_listener(listener)
    pubnub.subscribe().channels(list(channels)).execute()
    assert listener.connected_event.wait(WAIT_S), "the SDK never connected"
    return listener.message_queue


@pytest.mark.parametrize("post", [False, True], ids=["GET", "POST"])
@pytest.mark.parametrize("payload", PAYLOADS, ids=[f"payload{i}" for i in range(len(PAYLOADS))])
def test_the_sdk_receives_its_published_messages(standin, client, payload, post):
    received = subscribe(client(standin, uuid="page"), "iort.car")
    result = publish(client(standin), "iort.car", payload, post=post).result
    event = received.get(timeout=WAIT_S)
    assert event.message == payload
    assert type(event.message) is type(payload)
    assert (event.channel, event.subscription, event.publisher) == ("iort.car", None, "car")
    assert event.timetoken == result.timetoken
    assert len(str(result.timetoken)) == 17
    assert (standin.published, standin.delivered, standin.refused) == (1, 1, 0)


def test_a_compressed_post_is_published(standin, client):
    received = subscribe(client(standin), "iort.car")
    client(standin).publish().channel("iort.car").message({"a": 1}).use_post(True).use_compression().sync()
    assert received.get(timeout=WAIT_S).message == {"a": 1}


def test_a_wildcard_message_names_channel_and_subscription(standin, client):
    received = subscribe(client(standin), "iort.*")
    publisher = client(standin)
    publish(publisher, "other.car", "not for us")
    publish(publisher, "iort", "nor this")
    publish(publisher, "iort.car-1", 1)
    publish(publisher, "iort.car-2", 2)
    events = [received.get(timeout=WAIT_S) for _ in range(2)]
    assert [(e.channel, e.subscription, e.message) for e in events] == [
        ("iort.car-1", "iort.*", 1),
        ("iort.car-2", "iort.*", 2),
    ]


def test_a_channel_and_its_wildcard_deliver_a_message_once(standin, client):
    received = subscribe(client(standin), "iort.*", "iort.car", "else")
    publisher = client(standin)
    for channel in ("iort.car", "else", "iort.two"):
        publish(publisher, channel, channel)
    events = [received.get(timeout=WAIT_S) for _ in range(3)]
    assert [(e.message, e.subscription) for e in events] == [
        ("iort.car", None),
        ("else", None),
        ("iort.two", "iort.*"),
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


def test_the_first_subscribe_answers_at_once_with_a_cursor(standin, client):
    publish(client(standin), "iort.car", "before")
    token, messages = poll(standin, "iort.car", 0)
    assert messages == []
    publish(client(standin), "iort.car", "after")
    _, messages = poll(standin, "iort.car", token)
    assert [message["d"] for message in messages] == ["after"]


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


@pytest.mark.parametrize("action", ["heartbeat", "leave"])
def test_presence_requests_are_accepted(standin, action):
    response, body = ask(standin, f"/v2/presence/sub-key/sub/channel/iort.*/{action}?uuid=page")
    assert (response.status, json.loads(body)["status"]) == (200, 200)


def test_the_time_request_is_answered(standin, client):
    assert abs(int(client(standin).time().sync().result) / 1e7 - time.time()) < 60


def test_a_channel_group_subscription_is_accepted(standin):
    response, _ = ask(standin, "/v2/subscribe/sub/,/0?tt=0&channel-group=fleet")
    assert response.status == 200


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


@pytest.mark.parametrize("path", ["/time/0", "/nowhere", "/v2/subscribe/sub/iort.car/0?tt=0"])
def test_every_answer_allows_cross_origin_reads(standin, path):
    assert ask(standin, path)[0].headers["Access-Control-Allow-Origin"] == "*"


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


def test_the_server_can_stop_twice_and_start_again():
    standin = PubNubStandIn(port=free_port())
    standin.stop()
    for _ in range(2):
        with standin, pytest.raises(RuntimeError, match="running already"):
            standin.start()
        standin.stop()


def test_a_busy_port_raises_an_error(standin):
    with pytest.raises(OSError, match="ddress already in use"):
        PubNubStandIn(port=standin.port).start()


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
