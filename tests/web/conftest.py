"""A page that shows a car, the car, and servers of pages with answers of a test's own."""

from __future__ import annotations

from contextlib import ExitStack

import pytest

from iort_station.page.server import PageServer
from local.pubnub import PubNubStandIn
from testkit.ports import free_port
from tests.web.cars import GAIN, PUBLISH_KEY, SUBSCRIBE_KEY, Car
from tests.web.lab import Lab


@pytest.fixture(scope="module")
def pubnub():
    # A test may start it again.
    port = free_port()
    with PubNubStandIn(publish_key=PUBLISH_KEY, subscribe_key=SUBSCRIBE_KEY, port=port) as pubnub:
        yield pubnub


@pytest.fixture
def car(pubnub):
    return Car(pubnub)


@pytest.fixture
def serve(pubnub):
    """Serve a page that hears the cars, until the test ends."""
    with ExitStack() as stack:

        def served(**settings):
            listening = {"subscribe_key": SUBSCRIBE_KEY, "origin": pubnub.origin, "tls": False}
            return stack.enter_context(PageServer(namespace="iort", **{**listening, **settings}))

        yield served


@pytest.fixture
def url(serve):
    return serve(vehicles={"car-1": {"speed_to_erpm_gain": GAIN}}).url


@pytest.fixture
def page(open_page, url):
    return open_page(f"{url}#/car/car-1")


@pytest.fixture
def lab():
    return Lab()


@pytest.fixture
def server(serve, lab):
    """The lab's page."""
    return serve(**lab.served())
