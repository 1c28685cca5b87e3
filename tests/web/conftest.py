"""A page that shows a car, and the car."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from iort_station.page.server import PageServer
from local.pubnub import PubNubStandIn
from testkit.ports import free_port
from tests.web.cars import GAIN, PUBLISH_KEY, SUBSCRIBE_KEY, Car

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from playwright.sync_api import Page


@pytest.fixture
def pubnub() -> Iterator[PubNubStandIn]:
    # A test may start it again.
    port = free_port()
    with PubNubStandIn(publish_key=PUBLISH_KEY, subscribe_key=SUBSCRIBE_KEY, port=port) as pubnub:
        yield pubnub


@pytest.fixture
def car(pubnub: PubNubStandIn) -> Car:
    return Car(pubnub)


@pytest.fixture
def url(pubnub: PubNubStandIn) -> Iterator[str]:
    with PageServer(
        namespace="iort",
        subscribe_key=SUBSCRIBE_KEY,
        origin=pubnub.origin,
        tls=False,
        vehicles={"car-1": {"speed_to_erpm_gain": GAIN}},
    ) as server:
        yield server.url


@pytest.fixture
def page(open_page: Callable[..., Page], url: str) -> Page:
    return open_page(f"{url}#/car/car-1")
