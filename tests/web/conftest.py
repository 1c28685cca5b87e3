"""A page that shows a car, the car, and servers of pages with answers of a test's own."""

from __future__ import annotations

from contextlib import ExitStack
from typing import TYPE_CHECKING, Any

import pytest

from iort_station.page.server import PageServer
from local.pubnub import PubNubStandIn
from testkit.ports import free_port
from tests.web.cars import GAIN, PUBLISH_KEY, SUBSCRIBE_KEY, Car
from tests.web.lab import Lab

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from playwright.sync_api import Page


@pytest.fixture(scope="module")
def pubnub() -> Iterator[PubNubStandIn]:
    # A test may start it again.
    port = free_port()
    with PubNubStandIn(publish_key=PUBLISH_KEY, subscribe_key=SUBSCRIBE_KEY, port=port) as pubnub:
        yield pubnub


@pytest.fixture
def car(pubnub: PubNubStandIn) -> Car:
    return Car(pubnub)


@pytest.fixture
def serve(pubnub: PubNubStandIn) -> Iterator[Callable[..., PageServer]]:
    """Serve a page that hears the cars, until the test ends."""
    with ExitStack() as stack:

        def served(**settings: Any) -> PageServer:
            listening = {"subscribe_key": SUBSCRIBE_KEY, "origin": pubnub.origin, "tls": False}
            return stack.enter_context(PageServer(namespace="iort", **{**listening, **settings}))

        yield served


@pytest.fixture
def url(serve: Callable[..., PageServer]) -> str:
    return serve(vehicles={"car-1": {"speed_to_erpm_gain": GAIN}}).url


@pytest.fixture
def page(open_page: Callable[..., Page], url: str) -> Page:
    return open_page(f"{url}#/car/car-1")


@pytest.fixture
def lab() -> Lab:
    return Lab()


@pytest.fixture
def server(serve: Callable[..., PageServer], lab: Lab) -> PageServer:
    """The lab's page."""
    return serve(**lab.served())
