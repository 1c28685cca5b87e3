"""A page without a server at a broker with the limits of AWS IoT ("AWS IoT Core endpoints and quotas")."""

from __future__ import annotations

from typing import TYPE_CHECKING

from aiohttp import web

from iort_station.page.background import BackgroundServer
from iort_station.page.server import PageServer
from testkit.waiting import until

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from playwright.sync_api import Page

# Of one request to subscribe.
MOST_FILTERS = 8
CONNECT, SUBSCRIBE = 1, 8
CONNACK, SUBACK = bytes([0x20, 3, 0, 0, 0]), 0x90
CREDENTIALS = {"AccessKeyId": "ASIA", "SecretKey": "s", "SessionToken": "t"}


class Broker(BackgroundServer):
    """Gives anybody an identity, and ends a connection that subscribes to too much at once."""

    def __init__(self) -> None:
        super().__init__("127.0.0.1", 0)
        self.asked: list[int] = []

    async def handle(self, request: web.BaseRequest) -> web.StreamResponse:
        if request.path != "/mqtt":
            cors = {"Access-Control-Allow-Origin": "*", "Access-Control-Allow-Headers": "*"}
            return web.json_response({"IdentityId": "i", "Credentials": CREDENTIALS}, headers=cors)
        socket = web.WebSocketResponse(protocols=["mqtt"])
        await socket.prepare(request)
        async for message in socket:
            for kind, body in packets(message.data):
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


def packets(sent: bytes) -> Iterator[tuple[int, bytes]]:
    """The MQTT packets of a WebSocket's message: kind and body."""
    while sent:
        # The length in groups of seven bits; the last group has no high bit.
        ends = next(i for i in range(1, 5) if sent[i] < 0x80)
        length = sum((sent[i] & 0x7F) << 7 * (i - 1) for i in range(1, ends + 1))
        yield sent[0] >> 4, sent[ends + 1 : ends + 1 + length]
        sent = sent[ends + 1 + length :]


def test_a_page_of_many_cars_subscribes_within_the_limit_of_a_request(open_page: Callable[..., Page]) -> None:
    with Broker() as broker:
        socket = f"ws://127.0.0.1:{broker.port}"
        with PageServer(
            namespace="iort",
            live="iot",
            broker=socket,
            identity={
                "pool": "eu-west-1:1",
                "region": "eu-west-1",
                "endpoint": f"http://127.0.0.1:{broker.port}",
                "socket": f"{socket}/mqtt",
                "client_prefix": "iort-viewer-",
                "robots": [f"car{i}" for i in range(MOST_FILTERS + 1)],
            },
        ) as site:
            page = open_page(site.url)
            until(lambda: page.inner_text("#link") == "Connected", "the page to connect", 15)
    assert broker.asked == [MOST_FILTERS, 1]
