"""A car's past in a real browser: what is asked of the server, what is shown, and what the address keeps."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any

import pytest

from iort_contract.catalog.vesc import VESC_STREAM
from iort_station.page.server import PageServer
from tests.browser import until
from tests.web.cars import SUBSCRIBE_KEY

if TYPE_CHECKING:
    from playwright.sync_api import Page

    from local.pubnub.standin import PubNubStandIn


class Past:
    """Answers for a car with two streams; it records the requests."""

    def __init__(self) -> None:
        self.asked: list[dict[str, str]] = []

    def history(self, asked: Any) -> dict[str, Any]:
        self.asked.append(dict(asked))
        first = int(asked["from_us"]) / 1e6
        fields = {"voltage_input": {"mean": [12.0, 11.5]}}
        return {"times_s": [first, first + 1], "fields": fields, "samples": 2, "ros2": False, "row_s": 0}


@pytest.fixture
def past() -> Past:
    return Past()


@pytest.fixture
def server(pubnub: PubNubStandIn, past: Past) -> Iterator[PageServer]:
    answers: dict[str, Any] = {
        "streams": lambda _: {"streams": ["agent", VESC_STREAM]},
        "history": past.history,
    }
    told: dict[str, Any] = {"subscribe_key": SUBSCRIBE_KEY, "origin": pubnub.origin, "tls": False}
    with PageServer(namespace="iort", answers=answers, **told) as server:
        yield server


def test_another_stream_is_loaded_at_once_and_kept_in_the_address(
    open_page: Callable[..., Page], server: PageServer, past: Past
) -> None:
    page = open_page(f"{server.url}#/history/car-1")
    until(lambda: len(past.asked) == 1, "the first stream")
    page.locator("#stream").select_option("agent")
    until(lambda: len(past.asked) == 2, "the other stream")
    page.reload()
    until(lambda: len(past.asked) == 3, "the stream of the address")
    assert [asked["stream"] for asked in past.asked] == [VESC_STREAM, "agent", "agent"]
    assert page.url.endswith("#/history/car-1?stream=agent")
