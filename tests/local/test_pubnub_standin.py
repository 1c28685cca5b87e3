"""The stand-in for PubNub, as PubNub's own SDKs see it."""

from __future__ import annotations

import gzip
import http.client
import itertools
import json
import os
import queue
import shutil
import socket
import subprocess
import threading
import time
from pathlib import Path
from urllib.parse import quote

import pytest
from pubnub.enums import PNReconnectionPolicy
from pubnub.exceptions import PubNubException
from pubnub.pnconfiguration import PNConfiguration
from pubnub.pubnub import PubNub, SubscribeListener

import contract
from local import pubnub_standin
from local.pubnub_standin import History, Message, PubNubStandIn, Subscription

ROOT = Path(__file__).resolve().parents[2]
WAIT_S = 60


@pytest.fixture
def standin():
    with PubNubStandIn(publish_key="pub", subscribe_key="sub") as standin:
        yield standin


@pytest.fixture
def client():
    """Make clients of the real SDK, all closed at the end, before the server is."""
    made = []

    def make(standin, *, publish_key="pub", subscribe_key="sub", uuid="car"):
        configuration = PNConfiguration()
        configuration.publish_key, configuration.subscribe_key = publish_key, subscribe_key
        configuration.uuid, configuration.origin, configuration.ssl = uuid, standin.origin, False
        configuration.daemon, configuration.disable_config_locking = True, False
        configuration.reconnect_policy = PNReconnectionPolicy.LINEAR
        configuration.reconnection_interval = 0.1
        made.append(PubNub(configuration))
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


@pytest.mark.parametrize("post", [False, True], ids=["GET", "POST"])
@pytest.mark.parametrize("payload", PAYLOADS, ids=[f"payload{i}" for i in range(len(PAYLOADS))])
def test_sdk_receives_what_sdk_publishes(standin, client, payload, post):
    received = subscribe(client(standin, uuid="page"), "iort.car")
    result = publish(client(standin), "iort.car", payload, post=post).result
    event = received.get(timeout=WAIT_S)
    assert event.message == payload
    assert type(event.message) is type(payload)
    assert (event.channel, event.subscription, event.publisher) == ("iort.car", None, "car")
    assert event.timetoken == result.timetoken
    assert len(str(result.timetoken)) == 17
    assert (standin.published, standin.delivered, standin.refused) == (1, 1, 0)


def test_compressed_post(standin, client):
    received = subscribe(client(standin), "iort.car")
    client(standin).publish().channel("iort.car").message({"a": 1}).use_post(True).use_compression().sync()
    assert received.get(timeout=WAIT_S).message == {"a": 1}


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
def test_gzip(standin, body, answer):
    _, text = ask(standin, "/publish/pub/sub/0/c/0", "POST", body, {"Content-Encoding": "gzip"})
    assert json.loads(text)[:2] == answer


def test_wildcard_tells_the_channel_and_the_subscription(standin, client):
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


def test_channel_named_beside_its_wildcard_arrives_once(standin, client):
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


def test_200_messages_in_order_while_the_sdk_polls_again_and_again(client):
    with PubNubStandIn(poll_s=0.01) as standin:
        received, publisher = subscribe(client(standin), "iort.*"), client(standin)
        for number in range(200):
            publish(publisher, "iort.car", number)
        assert [received.get(timeout=WAIT_S).message for _ in range(200)] == list(range(200))
        assert received.empty()


def test_200_messages_in_order_while_polls_are_abandoned(standin, client):
    token, _ = poll(standin, "iort.*", 0)
    publisher = client(standin)

    def publish_all():
        for number in range(200):
            publish(publisher, f"iort.car-{number % 3}", number)

    thread = threading.Thread(target=publish_all)
    thread.start()
    numbers = []
    for turn in itertools.count():
        if turn % 2:  # asked, but gone before the answer
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


def test_first_subscribe_answers_at_once_and_later_ones_from_there(standin, client):
    publish(client(standin), "iort.car", "before")
    token, messages = poll(standin, "iort.car", 0)
    assert messages == []
    publish(client(standin), "iort.car", "after")
    _, messages = poll(standin, "iort.car", token)
    assert [message["d"] for message in messages] == ["after"]


def test_message_on_the_wire(standin):
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


def test_idle_poll_answers_empty_with_the_same_cursor():
    with PubNubStandIn(poll_s=0.05) as standin:
        token, _ = poll(standin, "iort.car", 0)
        assert poll(standin, "iort.car", token) == (token, [])


def test_cursor_from_a_clock_ahead_is_not_deaf(standin, client):
    future, received = "99999999999999999", queue.Queue()
    thread = threading.Thread(target=lambda: received.put(poll(standin, "iort.car", future)[1]))
    thread.start()
    wait_for_polls(standin, 1)
    publish(client(standin), "iort.car", "now")
    thread.join()
    assert [message["d"] for message in received.get()] == ["now"]


def test_timetokens_grow_even_if_the_clock_does_not(standin, monkeypatch):
    monkeypatch.setattr(pubnub_standin.time, "time_ns", lambda: 1_700_000_000_000_000_000)
    tokens = [json.loads(ask(standin, "/time/0")[1])[0] for _ in range(3)]
    assert tokens == sorted(set(tokens))


def wait_for_polls(standin, count):
    deadline = time.monotonic() + WAIT_S
    while len(standin._polls) != count:
        assert time.monotonic() < deadline, f"{len(standin._polls)} polls, expected {count}"
        threading.Event().wait(0.002)


def test_two_publishes_in_one_turn_of_the_loop(standin):
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


def test_subscriber_that_leaves_is_forgotten(standin):
    token, _ = poll(standin, "iort.car", 0)
    with socket.create_connection((standin.host, standin.port)) as gone:
        gone.sendall(f"GET /v2/subscribe/sub/iort.car/0?tt={token} HTTP/1.1\r\nHost: x\r\n\r\n".encode())
        wait_for_polls(standin, 1)
    wait_for_polls(standin, 0)


def test_too_many_polls_are_refused(standin, monkeypatch):
    monkeypatch.setattr(pubnub_standin, "MAX_POLLS", 0)
    response, _ = ask(standin, "/v2/subscribe/sub/iort.car/0?tt=1")
    assert response.status == 429


def test_subscriber_that_does_not_read_is_cut_off(monkeypatch):
    monkeypatch.setattr(pubnub_standin, "WRITE_S", 0.2)
    cut = threading.Event()

    class Watched(PubNubStandIn):
        def _cut(self, request):
            super()._cut(request)
            cut.set()

    with Watched() as standin, socket.socket() as slow:
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
def test_too_large(standin, client, post):
    pubnub = client(standin)
    room = contract.MAX_PUBNUB_BYTES - 100 - len("c") - 2 * len("%22")
    assert publish(pubnub, "c", "x" * room, post=post).result.timetoken
    with pytest.raises(PubNubException) as caught:
        publish(pubnub, "c", "x" * (room + 1), post=post)
    assert caught.value._status_code == 413
    assert json.loads(caught.value._errormsg)[:2] == [0, "Message Too Large"]
    assert (standin.published, standin.refused) == (1, 1)


def test_post_of_megabytes_is_too_large(standin):
    response, body = ask(standin, "/publish/pub/sub/0/c/0", "POST", json.dumps("x" * 3_000_000))
    assert (response.status, json.loads(body)[:2]) == (413, [0, "Message Too Large"])


@pytest.mark.parametrize(
    "keys", [{"publish_key": "no"}, {"subscribe_key": "no"}], ids=["publish", "subscribe"]
)
def test_wrong_key(standin, client, keys):
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
def test_wrong_key_of_a_subscriber(standin, path, service):
    response, body = ask(standin, path)
    assert response.status == 400
    assert json.loads(body) == {"status": 400, "service": service, "error": True, "message": "Invalid Key"}


def test_any_key_where_none_is_expected(client):
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
def test_refused(standin, path, status, message):
    response, body = ask(standin, path)
    answer = json.loads(body)
    assert (response.status, answer["message"] if isinstance(answer, dict) else answer[1]) == (
        status,
        message,
    )
    assert (standin.published, standin.refused) == (0, 1)


def test_sdk_sends_nan_and_is_refused(standin, client):
    with pytest.raises(PubNubException, match="Invalid JSON"):
        publish(client(standin), "iort.car", {"speed": float("nan")})


@pytest.mark.parametrize("action", ["heartbeat", "leave"])
def test_presence(standin, action):
    response, body = ask(standin, f"/v2/presence/sub-key/sub/channel/iort.*/{action}?uuid=page")
    assert (response.status, json.loads(body)["status"]) == (200, 200)


def test_time(standin, client):
    assert abs(int(client(standin).time().sync().result) / 1e7 - time.time()) < 60


def test_channel_group_subscription_is_let_through(standin):
    response, _ = ask(standin, "/v2/subscribe/sub/,/0?tt=0&channel-group=fleet")
    assert response.status == 200


def test_browser_preflight(standin):
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
def test_every_answer_may_be_read_by_a_page(standin, path):
    assert ask(standin, path)[0].headers["Access-Control-Allow-Origin"] == "*"


def test_sdk_goes_on_with_a_restarted_server(client):
    with PubNubStandIn() as standin:
        received = subscribe(client(standin), "iort.*")
        publish(client(standin), "iort.car", "before")
        assert received.get(timeout=WAIT_S).message == "before"
        wait_for_polls(standin, 1)
        standin.stop()  # with a poll open, which takes minutes to end by itself
    # Whether the SDK is back yet or not: its cursor is older than the message.
    with PubNubStandIn(port=standin.port) as restarted:
        publish(client(restarted), "iort.car", "after")
        assert received.get(timeout=WAIT_S).message == "after"


def test_stopping_twice_and_starting_again():
    standin = PubNubStandIn()
    standin.stop()
    for _ in range(2):
        with standin, pytest.raises(RuntimeError, match="running already"):
            standin.start()
        standin.stop()


def test_busy_port_is_an_error(standin):
    with pytest.raises(OSError, match="ddress already in use"):
        PubNubStandIn(port=standin.port).start()


def message(token, channel, size=1):
    return Message(token, channel, "", "x" * size)


def test_history_keeps_the_newest_of_a_channel():
    history = History()
    for token in range(1, 251):
        history.add(message(token, "a"))
    tokens = [kept.token for _, kept in history.after(0, Subscription(["a"]))]
    assert tokens == list(range(151, 251))


def test_history_is_bounded(monkeypatch):
    monkeypatch.setattr(pubnub_standin, "KEPT_CHANNELS", 3)
    monkeypatch.setattr(pubnub_standin, "KEPT_BYTES", 10)
    history, everything = History(), Subscription(["c.*"])
    for token in range(1, 6):
        history.add(message(token, f"c.{token}"))
    assert [kept.token for _, kept in history.after(0, everything)] == [3, 4, 5]
    history.add(message(6, "c.6", 9))
    assert [kept.token for _, kept in history.after(0, everything)] == [5, 6]
    history.add(message(7, "c.7", 1000))
    assert [kept.token for _, kept in history.after(0, everything)] == [7]


def test_what_a_channel_forgets_makes_room(monkeypatch):
    monkeypatch.setattr(pubnub_standin, "KEPT_BYTES", 1_000)
    history = History()
    history.add(message(1, "quiet"))
    for token in range(2, 500):
        history.add(message(token, "busy", 5))
    assert [kept.token for _, kept in history.after(0, Subscription(["quiet"]))] == [1]


def test_an_answer_is_bounded_and_its_cursor_goes_on_from_there():
    history, wanted = History(), Subscription(["c.*"])
    for token in range(1, 301):
        history.add(message(token, f"c.{token % 4}"))
    first = [kept.token for _, kept in history.after(0, wanted)]
    rest = [kept.token for _, kept in history.after(first[-1], wanted)]
    assert first == list(range(1, 101))
    assert rest == list(range(101, 201))


@pytest.fixture
def javascript():
    """Start the JavaScript SDK's subscriber; skip where Node or the package is absent."""
    node = shutil.which("node")
    modules = Path(os.environ.get("IORT_NODE_MODULES") or ROOT / "node_modules")
    if node is None or not (modules / "pubnub").is_dir():
        pytest.skip("needs node and the npm package pubnub: run make setup")
    processes = []

    def start(standin, channel, count):
        script = Path(__file__).with_name("pubnub_subscriber.cjs")
        command = [node, script, modules / "pubnub", standin.origin, channel, str(count)]
        process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        watchdog = threading.Timer(WAIT_S, process.kill)
        watchdog.start()
        processes.append((process, watchdog))
        return process

    yield start
    for process, watchdog in processes:
        watchdog.cancel()
        process.kill()
        process.communicate()


def lines(process):
    for line in process.stdout:
        yield json.loads(line)


def test_javascript_sdk_receives_what_python_publishes(standin, client, javascript):
    page = javascript(standin, "iort.*", len(PAYLOADS))
    printed = lines(page)
    assert next(printed) == {"status": "PNConnectedCategory"}
    publisher = client(standin)
    for payload in PAYLOADS:
        publish(publisher, "iort.car", payload)
    for payload in PAYLOADS:
        event = next(printed)
        assert (event["channel"], event["subscription"]) == ("iort.car", "iort.*")
        if payload != [1, [2.5, -0.1], 2**63, 1e308]:  # JavaScript's numbers are doubles
            assert event["message"] == payload
    assert page.wait(WAIT_S) == 0


def test_javascript_sdk_reconnects_to_a_restarted_server(client, javascript):
    with PubNubStandIn() as standin:
        page = javascript(standin, "iort.*", 2)
        printed = lines(page)
        assert next(printed) == {"status": "PNConnectedCategory"}
        publish(client(standin), "iort.car", "before")
        assert next(printed)["message"] == "before"
        standin.stop()
        with PubNubStandIn(port=standin.port) as restarted:
            publish(client(restarted), "iort.car", "after")
            seen = [next(printed)]
            while "message" not in seen[-1]:
                seen.append(next(printed, {"message": "nothing"}))
            assert seen[-1]["message"] == "after", seen
            assert page.wait(WAIT_S) == 0


def test_channel_names_are_unquoted(standin):
    token, _ = poll(standin, quote("grün.*"), 0)
    ask(standin, f"/publish/pub/sub/0/{quote('grün.1')}/0/1")
    _, [received] = poll(standin, quote("grün.*"), token)
    assert (received["c"], received["b"]) == ("grün.1", "grün.*")
