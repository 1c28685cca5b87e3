"""The page's ways to the broker: limits of a request, the relay, and who is kept awake by looking."""

from __future__ import annotations

import http.client
import threading
import time

import pytest
from aiohttp import web

from iort_contract.limits import LIVE_MAX_RATE_HZ
from iort_contract.messages.live import VIEW_LEASE_MS, VIEW_RENEW_S
from iort_station.page.background import BackgroundServer
from local.network.certificates import Authority
from local.network.servers import Relay
from testkit.waiting import GUARD_S, until
from tests.browser import show
from tests.web.broker import CONNACK, CONNECT, SUBACK, SUBSCRIBE, packets
from tests.web.cars import Car

# Of one request to subscribe.
MOST_FILTERS = 8
CREDENTIALS = {"AccessKeyId": "ASIA", "SecretKey": "s", "SessionToken": "t"}


class Broker(BackgroundServer):
    """Gives anybody an identity, and ends a connection that subscribes to too much at once."""

    def __init__(self):
        super().__init__("127.0.0.1", 0)
        self.asked = []

    async def handle(self, request):
        if request.path != "/mqtt":
            cors = {"Access-Control-Allow-Origin": "*", "Access-Control-Allow-Headers": "*"}
            return web.json_response({"IdentityId": "i", "Credentials": CREDENTIALS}, headers=cors)
        socket = web.WebSocketResponse(protocols=["mqtt"])
        await socket.prepare(request)
        sent = bytearray()
        async for message in socket:
            sent += message.data
            for kind, body in packets(sent):
                if kind == CONNECT:
                    await socket.send_bytes(CONNACK)
                elif kind == SUBSCRIBE:
                    count = body.count(b"live/iort/")
                    self.asked.append(count)
                    if count > MOST_FILTERS:
                        return socket
                    # The packet's number, no properties, and QoS 0 for each.
                    granted = body[:2] + bytes(1 + count)
                    await socket.send_bytes(bytes([SUBACK, len(granted)]) + granted)
        return socket


def test_a_page_of_many_cars_subscribes_within_the_limit_of_a_request(open_page, serve):
    with Broker() as broker:
        socket = f"ws://127.0.0.1:{broker.port}"
        identity = {
            "pool": "eu-west-1:1",
            "region": "eu-west-1",
            "endpoint": f"http://127.0.0.1:{broker.port}",
            "socket": f"{socket}/mqtt",
            "client_prefix": "iort-viewer-",
            "robots": [f"car{i}" for i in range(MOST_FILTERS + 1)],
        }
        page = open_page(serve(live="iot", broker=socket, identity=identity).url)
        until(lambda: page.inner_text("#link") == "Connected", "the page to connect")
    assert broker.asked == [MOST_FILTERS, 1]


REFUSED, NO_GATEWAY = 403, 502


@pytest.fixture
def relay(tmp_path):
    (tmp_path / "ca.pem").write_text(Authority().pem)
    # Nothing listens on port 9.
    with Relay("127.0.0.1", 0, gateway="https://127.0.0.1:9", authority=str(tmp_path / "ca.pem")) as relay:
        yield relay


@pytest.mark.parametrize(
    ("origin", "status"),
    [
        ("http://127.0.0.1:8080", NO_GATEWAY),
        ("http://localhost:8080", NO_GATEWAY),
        ("http://[::1]:8080", NO_GATEWAY),
        (None, NO_GATEWAY),
        ("https://elsewhere.example", REFUSED),
        ("http://127.0.0.1.elsewhere.example", REFUSED),
        ("http://192.0.2.1", REFUSED),
        ("null", REFUSED),
    ],
)
def test_only_a_page_of_this_machine_gets_through(relay, origin, status):
    socket = {"Connection": "Upgrade", "Upgrade": "websocket", "Sec-WebSocket-Protocol": "mqtt"}
    call = {"Content-Type": "application/x-amz-json-1.1", "X-Amz-Target": "AWSCognitoIdentityService.GetId"}
    for method, path, headers in (("GET", "/mqtt", socket), ("POST", "/", call)):
        connection = http.client.HTTPConnection(relay.host, relay.port, timeout=GUARD_S)
        connection.request(method, path, headers=headers | ({"Origin": origin} if origin else {}))
        assert connection.getresponse().status == status
        connection.close()


HIDE = """(hidden) => {
  Object.defineProperty(document, "hidden", { value: hidden, configurable: true });
  document.dispatchEvent(new Event("visibilitychange"));
}"""

# The states of a car until it is stale, and how old its newest values were at each look.
UNTIL_STALE = """() => new Promise((done) => {
  const states = [];
  const look = () => {
    const { state, streams } = iort.robots["car-1"];
    states.push([state, streams.vesc.age_s]);
    if (["stale", "gone"].includes(state)) done(states);
    else setTimeout(look, 20);
  };
  look();
})"""
NO_RENEWAL = f"""const every = setInterval;
window.setInterval = (call, ms) => ms === {VIEW_RENEW_S * 1000:.0f} ? 0 : every(call, ms);"""


class Leases:
    """Keeps what the page's server was asked for."""

    def __init__(self):
        self.asked = []
        # The ends of leases wait for it.
        self.ends = threading.Event()
        self.ends.set()

    def view(self, asked):
        if asked["lease_ms"] == "0":
            assert self.ends.wait(GUARD_S)
        self.asked.append({**asked, "ends_s": time.monotonic() + int(asked["lease_ms"]) / 1000})
        return {"asked": asked["robots"].count(",") + 1}

    def held(self):
        """The highest rate of each robot with a lease."""
        held = {}
        for asked in list(self.asked):
            for robot in asked["robots"].split(","):
                held.pop((robot, asked["viewer"]), None)
                # As a car does: a renewal may arrive after the end that has overtaken it.
                if time.monotonic() < asked["ends_s"]:
                    held[robot, asked["viewer"]] = float(asked["rate_hz"])
        return {robot: rate_hz for (robot, _), rate_hz in sorted(held.items(), key=lambda one: one[1])}


@pytest.fixture
def leases():
    return Leases()


@pytest.fixture
def served(serve, leases):
    presence = {"online": True, "since_ms": 0}
    answers = {
        "robots": lambda _: {"robots": {"car-99": presence, "car-98": {**presence, "online": False}}},
        "tags": lambda _: {"tags": {}},
        "vehicles": lambda _: {"vehicles": {}},
    }
    return serve(answers=answers, open_actions={"view": leases.view}).url


def test_the_page_holds_what_is_on_the_screen_and_nothing_while_hidden_or_closed(
    open_page, pubnub, served, leases
):
    page = open_page(served, viewport={"width": 700, "height": 400})
    # It is connected, and has not been heard.
    until(lambda: leases.held() == {"car-99": 1.0}, "a look at the registered car")
    for number in range(20):
        Car(pubnub, f"car-{number}").send()
    until(lambda: "car-0" in leases.held(), "a look at the first cards")
    # It is held until its card has a place, which is below the screen.
    until(lambda: "car-0" in (held := leases.held()) and "car-19" not in held, "the cards below to be let")
    until(lambda: f"{len(leases.held())} cars held awake" in page.inner_text(".foot"), "the bar to say so")
    page.goto(f"{served}#/car/car-7")
    until(lambda: leases.held() == {"car-7": LIVE_MAX_RATE_HZ}, "one car in full")
    until(lambda: "1 car held awake" in page.inner_text(".foot"), "the bar to say so")
    last = leases.asked[-1]
    until(lambda: leases.asked[-1] is not last, "the lease to be renewed")
    assert leases.asked[-1] == {**leases.asked[-1], "robots": "car-7", "lease_ms": str(VIEW_LEASE_MS)}
    page.evaluate(HIDE, True)
    until(lambda: leases.held() == {}, "the hidden page to let it sleep")
    page.evaluate(HIDE, False)
    until(lambda: leases.held() == {"car-7": LIVE_MAX_RATE_HZ}, "the page that is seen again")
    page.goto(f"{served}#/alarms")
    until(lambda: leases.held() == {}, "a view that needs no more than cars send by themselves")
    page.goto(f"{served}#/history/car-7")
    until(lambda: leases.held() == {"car-7": 1.0}, "the value beside the past")
    assert len({asked["viewer"] for asked in leases.asked}) == 1
    other = open_page(f"{served}#/car/car-7")
    until(lambda: leases.held() == {"car-7": LIVE_MAX_RATE_HZ}, "another viewer")
    assert len({asked["viewer"] for asked in leases.asked}) == 2
    other.close()
    until(lambda: leases.held() == {"car-7": 1.0}, "the closed page's last word")


def test_an_idle_car_is_not_stale_and_is_gone_when_it_breaks_its_word(page, car):
    show(page, car.send(next_ms=60_000))
    until(lambda: page.get_attribute("#car", "data-state") == "idle", "the car to be idle")
    assert "idle: newest values are" in page.inner_text(".car-state")
    assert page.inner_text("#count") == "1 idle"
    assert "cannot wake cars" in page.inner_text(".foot")
    show(page, car.send(next_ms=4_000))
    # After its word and a little more; a busy machine may look at it later.
    word_s = 5.4
    *before, (_, age_s) = page.evaluate(UNTIL_STALE)
    assert {state for state, _ in before} <= {"live", "idle"}
    assert age_s >= word_s
    # The promise of ten a second.
    show(page, car.send(next_ms=100))
    assert all(age_s < word_s for _, age_s in page.evaluate(UNTIL_STALE)[:-1])
    car.send(next_ms=10**6)
    until(lambda: page.evaluate("iort.malformed") == 1, "a time that no car may say")


def test_a_car_that_is_looked_at_again_is_held_though_the_end_arrives_late(open_page, served, leases):
    page = open_page(f"{served}#/alarms")
    page.add_init_script(NO_RENEWAL)
    page.reload()
    # The page asks again when it is connected.
    until(lambda: page.inner_text("#link") == "Connected", "the page to connect")
    page.goto(f"{served}#/car/car-99")
    until(lambda: leases.held() == {"car-99": LIVE_MAX_RATE_HZ}, "the car to be held")
    leases.ends.clear()
    known = len(leases.asked)
    page.evaluate(HIDE, True)
    page.evaluate(HIDE, False)
    until(lambda: len(leases.asked) > known, "the new look")
    leases.ends.set()
    until(lambda: len(leases.asked) > known + 2, "the end, and a renewal")
    told = [asked["lease_ms"] for asked in leases.asked[known:]]
    assert told == [str(VIEW_LEASE_MS), "0", str(VIEW_LEASE_MS)]
    assert leases.held() == {"car-99": LIVE_MAX_RATE_HZ}
