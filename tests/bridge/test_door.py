"""The door refuses who has no business in the bridge, each with a clear line, and nobody else notices."""

from __future__ import annotations

import asyncio
import json
import logging
import struct
from collections.abc import Callable, Iterator
from contextlib import AsyncExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any

import pytest
from aiohttp import ClientSession, ClientWebSocketResponse, WSMsgType, WSServerHandshakeError
from argon2 import PasswordHasher

from iort_station.bridge.channels import Channels, Message, Topic
from iort_station.bridge.door import MOST_BYTES, PROTOCOL, Admission, ByPassword, Door, everybody, one_key
from iort_station.page.password import TRIES, Password
from testkit.waiting import GUARD_S, until
from tests.bridge.judge import Judge

TOPIC = Topic("/iort/vesc", "json", "iort.vesc", "jsonschema", b'{"type": "object"}')
MESSAGE = Message(1_700_000_000_000_000_000, 0, b'{"speed": 1}')


@contextmanager
def served(admits: Admission = everybody, **how: Any) -> Iterator[tuple[Channels, str]]:
    """A bridge with one topic, and its address."""
    with (
        Channels("tested", topics=[TOPIC], backlog=how.pop("backlog", 64)) as channels,
        Door("127.0.0.1", 0, inner=f"ws://{channels.host}:{channels.port}/", admits=admits, **how) as door,
    ):
        yield channels, f"ws://127.0.0.1:{door.port}/"


def run(work: Callable[[ClientSession], Any]) -> Any:
    """What a client of aiohttp does."""

    async def within() -> Any:
        async with ClientSession() as session:
            return await asyncio.wait_for(work(session), GUARD_S)

    return asyncio.run(within())


def refused(url: str, protocols: tuple[str, ...] = (PROTOCOL,), **headers: str) -> tuple[int, str]:
    """The status and the words with which a client is refused; 101 if it may come in."""

    async def work(session: ClientSession) -> tuple[int, str]:
        upgrade = {"Connection": "Upgrade", "Upgrade": "websocket", "Sec-WebSocket-Version": "13"}
        key = {"Sec-WebSocket-Key": "dGhlIHNhbXBsZSBub25jZQ=="}
        sent = {**upgrade, **key, "Sec-WebSocket-Protocol": ", ".join(protocols), **headers}
        async with session.get(url.replace("ws:", "http:"), headers=sent) as answer:
            return answer.status, "" if answer.status == 101 else (await answer.text()).strip()

    found: tuple[int, str] = run(work)
    return found


def cut_off(url: str, send: Callable[[ClientWebSocketResponse[bool]], Any]) -> tuple[int | None, str]:
    """The close code and the words with which a client that does this is cut off."""

    async def work(session: ClientSession) -> tuple[int | None, str]:
        async with session.ws_connect(url, protocols=[PROTOCOL]) as client:
            await send(client)
            while (message := await client.receive()).type not in {WSMsgType.CLOSE, WSMsgType.CLOSED}:
                pass
            return client.close_code, message.extra or ""

    found: tuple[int | None, str] = run(work)
    return found


async def subscribed(client: ClientWebSocketResponse[bool]) -> None:
    """Subscribe to the topic, and wait until the server has done so."""
    channel = None
    while channel is None:
        told = json.loads((await client.receive()).data)
        channel = told["channels"][0]["id"] if told["op"] == "advertise" else None
    await client.send_json({"op": "subscribe", "subscriptions": [{"id": 1, "channelId": channel}]})


@pytest.mark.parametrize(
    ("offered", "words"),
    [
        (("foxglove.websocket.v1",), "got foxglove.websocket.v1: this client is too old"),
        (("mqtt", "soap"), "got mqtt, soap"),
        ((), "got none"),
    ],
)
def test_another_protocol_is_refused(offered: tuple[str, ...], words: str) -> None:
    with served() as (_, url):
        assert refused(url, offered) == (400, f"the WebSocket's protocol must be {PROTOCOL}, {words}")


@pytest.mark.parametrize(
    ("origin", "status"),
    [
        ("https://evil.example", 403),
        ("null", 403),
        ("http://[evil", 403),
        ("http://127.0.0.1.evil.example", 403),
        ("https://app.foxglove.dev.evil.example", 403),
        ("https://app.foxglove.dev", 101),
        ("http://localhost:8080", 101),
        ("file://", 101),
        ("https://lichtblick.lab", 101),
    ],
)
def test_a_page_of_the_internet_cannot_use_the_operators_browser(origin: str, status: int) -> None:
    with served(origins=["https://Lichtblick.lab/"]) as (_, url):
        got, words = refused(url, Origin=origin)
    assert got == status
    assert (f"`iort bridge --origin {origin}` allows it" in words) == (status == 403)


def test_a_browser_that_opens_the_address_is_told_what_it_is() -> None:
    with served() as (_, url):
        status, words = refused(url, Upgrade="h2c")
    assert (status, words) == (
        426,
        "this is no page: open its address in Foxglove, as a `Foxglove WebSocket`",
    )


def test_a_key_is_needed_where_there_is_one() -> None:
    with served(one_key("s3cret")) as (_, url):
        for given in ("", "?key=", "?key=s3cre", "?key=s3crets", "?key=%ff", "?other=s3cret"):
            status, words = refused(url + given)
            assert (status, "?key=" in words) == (401, True), given
        assert refused(f"{url}?key=s3cret")[0] == 101


def test_the_password_can_be_guessed_a_few_times_and_who_has_it_may_connect_again(tmp_path: Path) -> None:
    password = Password(tmp_path, PasswordHasher(time_cost=1, memory_cost=8, parallelism=1))
    password.set("correct horse")
    with served(ByPassword(password)) as (_, url):
        assert refused(f"{url}?key=correct%20horse")[0] == 101
        # What was right is no try.
        for _ in range(2 * TRIES):
            assert refused(f"{url}?key=correct%20horse")[0] == 101
        guesses = [refused(f"{url}?key=guess{i}")[0] for i in range(TRIES)]
        assert guesses == [401] * (TRIES - 1) + [429]
        assert refused(f"{url}?key=correct%20horse")[0] == 101
        password.set("another horse")
        assert refused(f"{url}?key=correct%20horse")[0] in {401, 429}


def test_a_password_that_was_removed_lets_nobody_in(tmp_path: Path) -> None:
    password = Password(tmp_path, PasswordHasher(time_cost=1, memory_cost=8, parallelism=1))
    password.set("correct horse")
    with served(ByPassword(password)) as (_, url):
        (tmp_path / "page-password").unlink()
        status, words = refused(f"{url}?key=correct%20horse")
    assert (status, "the password cannot be read" in words) == (503, True)


@pytest.mark.parametrize(
    ("send", "code", "words"),
    [
        (lambda client: client.send_str("no json {"), 1007, "a text message must be an object of JSON"),
        (lambda client: client.send_str("[" * 100_000), 1007, "a text message must be an object of JSON"),
        (lambda client: client.send_str('["subscribe"]'), 1007, "a text message must be an object of JSON"),
        (
            lambda client: client.send_bytes(b"\1" * (MOST_BYTES + 1)),
            1009,
            f"a message must have at most {MOST_BYTES} bytes",
        ),
    ],
)
def test_a_broken_client_is_cut_off_and_told_why(
    send: Any, code: int, words: str, caplog: pytest.LogCaptureFixture
) -> None:
    with served() as (channels, url), Judge(url) as judge, caplog.at_level(logging.WARNING, "iort"):
        judge.do("subscribe", topic=TOPIC.name)
        got, told = cut_off(url, send)
        assert (got, told) == (code, words)
        _is_served(channels, judge)
        until(lambda: [one for one in caplog.records if one.name == "iort"])
    assert len([one for one in caplog.records if one.name == "iort"]) == 1


def test_a_client_that_floods_is_cut_off_and_the_others_are_served() -> None:
    async def flood(client: ClientWebSocketResponse[bool]) -> None:
        for _ in range(2000):
            await client.send_json({"op": "unsubscribe", "subscriptionIds": []})

    with served() as (channels, url), Judge(url) as judge:
        judge.do("subscribe", topic=TOPIC.name)
        # It may be cut off while it still sends.
        with suppress(ConnectionError):
            assert cut_off(url, flood) == (1008, "a client may send 200 messages a second")
        _is_served(channels, judge)


def test_pings_are_answered_and_a_flood_of_them_is_cut_off() -> None:
    async def ping(session: ClientSession) -> bytes:
        async with session.ws_connect(url, protocols=[PROTOCOL], autoping=False) as client:
            await client.ping(b"there?")
            while (message := await client.receive()).type is not WSMsgType.PONG:
                assert message.type in {WSMsgType.TEXT, WSMsgType.BINARY}
            return bytes(message.data)

    async def flood(client: ClientWebSocketResponse[bool]) -> None:
        for _ in range(2000):
            await client.ping()

    with served() as (channels, url), Judge(url) as judge:
        judge.do("subscribe", topic=TOPIC.name)
        assert run(ping) == b"there?"
        with suppress(ConnectionError):
            assert cut_off(url, flood) == (1008, "a client may send 200 messages a second")
        _is_served(channels, judge)


def _is_served(channels: Channels, judge: Judge) -> None:
    until(channels.wanted)
    before = len(list(judge.got()))
    channels.send(MESSAGE)
    until(lambda: len(list(judge.got())) > before)


def test_twenty_clients_are_served_and_one_too_many_is_told_so() -> None:
    async def work(session: ClientSession) -> tuple[int, list[bytes]]:
        async with AsyncExitStack() as stack:
            clients = [
                await stack.enter_async_context(session.ws_connect(url, protocols=[PROTOCOL]))
                for _ in range(20)
            ]
            with pytest.raises(WSServerHandshakeError) as refusal:
                await session.ws_connect(url, protocols=[PROTOCOL])
            for client in clients:
                await subscribed(client)
            got: list[bytes] = []
            sent = asyncio.create_task(_send_until(channels, lambda: len(got) >= 20))
            got.extend([await _first_data(client) for client in clients])
            await sent
            return refusal.value.status, got

    with served(most_clients=20) as (channels, url):
        status, got = run(work)
    assert status == 503
    assert got == [MESSAGE.data] * 20


def test_many_that_come_at_once_are_no_more_than_may_come() -> None:
    async def work(session: ClientSession) -> int:
        came = await asyncio.gather(
            *(session.ws_connect(url, protocols=[PROTOCOL]) for _ in range(20)), return_exceptions=True
        )
        clients = [one for one in came if not isinstance(one, BaseException)]
        for client in clients:
            await client.close()
        return len(clients)

    with served(most_clients=3) as (_, url):
        assert run(work) == 3


async def _send_until(channels: Channels, done: Callable[[], bool]) -> None:
    while not done():
        channels.send(MESSAGE)
        await asyncio.sleep(0.02)


async def _first_data(client: ClientWebSocketResponse[bool]) -> bytes:
    while True:
        message = await client.receive()
        if message.type is WSMsgType.BINARY and message.data[0] == 1:
            return bytes(message.data[13:])


def test_a_slow_client_loses_only_its_own_messages() -> None:
    """It reads nothing while megabytes are sent; the other one gets every message, in order."""
    large, count = b"x" * 100_000, 600

    async def work(session: ClientSession) -> tuple[list[int], list[int]]:
        async with (
            session.ws_connect(url, protocols=[PROTOCOL], max_msg_size=0) as slow,
            session.ws_connect(url, protocols=[PROTOCOL], max_msg_size=0) as quick,
        ):
            await subscribed(slow)
            await subscribed(quick)
            await asyncio.to_thread(until, lambda: channels.subscribers(0) == 2)
            got: list[int] = []
            for i in range(count):
                channels.send(Message(i, 0, large))
                got.append(await _time(quick))
            late: list[int] = []
            channels.send(Message(count, 0, b"last"))
            while not late or late[-1] != count:
                late.append(await _time(slow))
            return got, late

    with served(backlog=64) as (channels, url):
        quick, slow = run(work)
    assert quick == list(range(count))
    assert slow == sorted(slow)
    assert len(slow) < count


async def _time(client: ClientWebSocketResponse[bool]) -> int:
    while True:
        message = await client.receive()
        if message.type is WSMsgType.BINARY and message.data[0] == 1:
            return int(struct.unpack_from("<Q", message.data, 5)[0])
