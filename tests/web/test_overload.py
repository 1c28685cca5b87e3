"""The page's server when it has more to do than it can: what stops and drives waits for nothing else."""

from __future__ import annotations

import asyncio
import http.client
import json
import select
import socket
import threading
from contextlib import ExitStack, closing

import pytest

from iort_station.errors import StationError
from iort_station.page.places import (
    ANSWERS_OF_CLIENT,
    ANSWERS_OF_KIND,
    MOST_ANSWERS,
    MOST_DOWNLOADS,
    MOST_WAITING,
    PENDING_OF_CLIENT,
    Busy,
    Places,
    client_of,
)
from iort_station.page.server import PageServer
from testkit.waiting import GUARD_S
from tests.web.cars import SETTINGS

HERE = "127.0.0.1"
READ = ("history", "runs", "rejected", "insights")


class Held:
    """Answers that end when the test ends. ``begun`` counts them, and ``ended`` is empty until then."""

    def __init__(self):
        self.begun, self.go_on = threading.Semaphore(0), threading.Event()
        self.ended = []
        self.sent = []

    def wait(self, count):
        """Wait until so many more have begun."""
        for _ in range(count):
            assert self.begun.acquire(timeout=GUARD_S)

    def answer(self, name):
        def hold(_asked):
            self.begun.release()
            self.go_on.wait()
            self.ended.append(name)
            return {}

        return hold

    def download(self, _asked, _folder):
        self.answer("download")({})
        raise StationError("nothing is stored")

    def send(self, asked):
        """A robot that is away answers when the test ends."""
        self.sent.append(asked["robot"])
        self.begun.release()
        while asked["robot"] == "away" and not self.go_on.is_set():
            yield
        return {"robot": asked["robot"]}


@pytest.fixture
def held():
    held = Held()
    yield held
    held.go_on.set()


@pytest.fixture
def page(tmp_path, held):
    (tmp_path / "index.html").write_text("<!doctype html><title>page</title>")
    quick = {name: lambda _asked: {"done": True} for name in ("motion", "socket")}
    with PageServer(
        **SETTINGS,
        built=tmp_path,
        answers={**{name: held.answer(name) for name in READ}, **quick},
        actions={
            "stop": lambda asked: {"robot": asked["robot"]},
            "drive": lambda _asked: {"done": True},
            "send": held.send,
            "set": held.answer("set"),
        },
        open_actions={"view": lambda _asked: {"done": True}, "acknowledge": held.answer("acknowledge")},
        downloads={"history.csv": held.download},
    ) as page:
        try:
            yield page
        finally:
            held.go_on.set()


class Client:
    """Requests of one address, each over a connection of its own that stays open."""

    def __init__(self, page, stack, address=HERE):
        self._page, self._stack, self._address = page, stack, address
        self._key = {"X-Iort-Key": page.__dict__["_key"]}

    def _open(self):
        connection = http.client.HTTPConnection(
            self._page.host, self._page.port, timeout=GUARD_S, source_address=(self._address, 0)
        )
        return self._stack.enter_context(closing(connection))

    def begin(self, path, asked=None, *, body=True):
        """Send a request, and wait for nothing."""
        connection = self._open()
        content = json.dumps(asked).encode()
        connection.putrequest("GET" if asked is None else "POST", path, skip_host=True)
        headers = {"Host": "localhost", "Origin": "http://localhost", "Content-Type": "application/json"}
        length = {} if asked is None else {"Content-Length": str(len(content))}
        for name, value in {**headers, **self._key, **length}.items():
            connection.putheader(name, value)
        connection.endheaders(content if asked is not None and body else None)
        return connection

    def ask(self, path, asked=None):
        answer = self.begin(path, asked).getresponse()
        if answer.status in {429, 503}:
            assert answer.headers["Retry-After"] == "1"
        return answer.status, json.loads(answer.read())


def test_a_stop_is_handled_while_everything_else_is_held(page, held):
    with ExitStack() as stack:
        for address in (HERE, "127.0.0.2", "127.0.0.3", "127.0.0.4"):
            client = Client(page, stack, address)
            for name in READ:
                for _ in range(15):
                    client.begin(f"/{name}.json")
            for _ in range(40):
                client.begin("/send.json", {"robot": "away"})
                client.begin("/stop.json", {"robot": "a body that never comes"}, body=False)
            for _ in range(8):
                client.begin("/set.json", {"robot": "car1"})
                client.begin("/acknowledge.json", {"alarm": "x"})
                client.begin("/history.csv")
        # Every place is taken: of answers, of actions, of downloads; and sends wait without one.
        held.wait(MOST_ANSWERS + MOST_ANSWERS + MOST_DOWNLOADS)
        client = Client(page, stack)
        for robot in ("car1", "car2"):
            assert client.ask("/stop.json", {"robot": robot}) == (200, {"robot": robot})
        for name in ("view", "drive"):
            assert client.ask(f"/{name}.json", {}) == (200, {"done": True})
        for name in ("motion", "socket"):
            assert client.ask(f"/{name}.json") == (200, {"done": True})
        assert client.ask("/key.json", {"token": page.invitation().rpartition("=")[2]})[0] == 200
        assert client.ask("/config.json")[0] == 200
        assert held.ended == []


def test_one_client_takes_neither_all_places_nor_those_of_other_kinds(page, held):
    def threads():
        return sum(thread.name == "page answer" for thread in threading.enumerate())

    with ExitStack() as stack:
        one, other = Client(page, stack), Client(page, stack, "127.0.0.2")
        for _ in range(ANSWERS_OF_KIND + 5):
            one.begin("/runs.json")
        held.wait(ANSWERS_OF_KIND)
        one.begin("/rejected.json")
        held.wait(1)
        for _ in range(ANSWERS_OF_CLIENT):
            one.begin("/insights.json")
        held.wait(ANSWERS_OF_CLIENT - ANSWERS_OF_KIND - 1)
        assert one.ask("/config.json")[0] == 200
        assert threads() == ANSWERS_OF_CLIENT
        other.begin("/history.json")
        held.wait(1)
        assert held.ended == []


def test_what_cannot_wait_is_refused_with_a_reason(page, held):
    with ExitStack() as stack:
        client = Client(page, stack)
        requests = [client.begin("/runs.json") for _ in range(ANSWERS_OF_KIND + MOST_WAITING + 1)]
        (refused,), _, _ = select.select([one.sock for one in requests], [], [], GUARD_S)
        (last,) = (one for one in requests if one.sock is refused)
        requests.remove(last)
        answer = last.getresponse()
        assert (answer.status, answer.headers["Retry-After"]) == (429, "1")
        assert json.loads(answer.read()) == {"error": "too many requests of this client: try again"}
        held.go_on.set()
        assert [one.getresponse().status for one in requests] == [200] * len(requests)


def test_a_send_that_waits_holds_no_place(page, held):
    with ExitStack() as stack:
        client = Client(page, stack)
        waiting = [client.begin("/send.json", {"robot": "away"}) for _ in range(PENDING_OF_CLIENT)]
        held.wait(PENDING_OF_CLIENT)
        # One that cannot wait is not sent either.
        assert client.ask("/send.json", {"robot": "late"})[0] == 429
        other = Client(page, stack, "127.0.0.2")
        assert other.ask("/send.json", {"robot": "car1"}) == (200, {"robot": "car1"})
        assert (held.sent.count("away"), held.sent[-1]) == (PENDING_OF_CLIENT, "car1")
        held.go_on.set()
        for one in waiting:
            assert json.loads(one.getresponse().read()) == {"robot": "away"}


def test_places_are_free_again_although_their_viewers_left(page, held):
    with ExitStack() as stack:
        client = Client(page, stack)
        for _ in range(ANSWERS_OF_KIND):
            client.begin("/runs.json")
        client.begin("/history.csv")
        held.wait(ANSWERS_OF_KIND + 1)
    with ExitStack() as stack:
        client = Client(page, stack)
        waiting = [client.begin("/runs.json"), client.begin("/history.csv")]
        assert client.ask("/motion.json")[0] == 200
        assert not held.begun.acquire(blocking=False)
        held.go_on.set()
        assert [one.getresponse().status for one in waiting] == [200, 400]


def test_a_body_that_never_comes_ends_the_request(tmp_path):
    (tmp_path / "index.html").touch()
    keyed = {"act": lambda _: {}}
    with PageServer(**SETTINGS, built=tmp_path, actions=keyed, body_s=0.01) as page, ExitStack() as stack:
        answer = Client(page, stack).begin("/act.json", {"a": "b"}, body=False).getresponse()
        assert (answer.status, answer.headers["Connection"]) == (408, "close")
        # The body of a GET is not waited for.
        with socket.create_connection((page.host, page.port)) as sender:
            sender.settimeout(60)
            sender.sendall(b"GET /config.json HTTP/1.1\r\nHost: localhost\r\nContent-Length: 9\r\n\r\n")
            assert sender.recv(12) == b"HTTP/1.1 200"


@pytest.mark.parametrize(
    ("address", "client"),
    [
        ("192.168.1.7", "192.168.1.7"),
        ("fe80::1%eth0", "fe80::/64"),
        ("2001:db8::7", "2001:db8::/64"),
        ("", ""),
    ],
)
def test_an_ipv6_network_is_one_client(address, client):
    assert client_of(address) == client


def test_who_has_the_fewest_places_is_next():
    async def order():
        places = Places(2, of_client=2, of_kind=2, waiting=2, wait_s=60)
        served = []

        async def work(client):
            await places.take(client, "read")
            served.append(client)

        await work("a")
        await work("a")
        tasks = []
        for client in ("a", "a", "b"):
            tasks.append(asyncio.create_task(work(client)))
            await asyncio.sleep(0)
        with pytest.raises(Busy) as busy:
            await places.take("a", "read")
        assert busy.value.own
        tasks[0].cancel()
        await asyncio.sleep(0)
        for client in ("a", "a", "b"):
            places.free(client, "read")
            await asyncio.sleep(0)
        await asyncio.gather(*tasks[1:])
        return served

    assert asyncio.run(order()) == ["a", "a", "b", "a"]


def test_a_place_that_does_not_come_in_time_is_refused():
    async def wait():
        places = Places(1, of_client=1, of_kind=1, waiting=1, wait_s=0)
        await places.take("a", "read")
        with pytest.raises(Busy) as busy:
            await places.take("b", "read")
        places.free("a", "read")
        await places.take("c", "read")
        return busy.value

    assert not asyncio.run(wait()).own
