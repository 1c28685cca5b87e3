"""Registered cars without live messages: the page shows since when, and links to their history."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from iort_station.page.server import PageServer
from tests.browser import until
from tests.web.cars import SUBSCRIBE_KEY, Car

if TYPE_CHECKING:
    from playwright.sync_api import Page

    from local.pubnub.standin import PubNubStandIn

OFF_MS = 1_700_000_000_000
REGISTERED = {
    "car-10": {"online": False, "since_ms": None},
    "car-2": {"online": False, "since_ms": OFF_MS},
    "car-3": {"online": True, "since_ms": OFF_MS},
}


def test_absent_cars_are_listed_until_they_send(
    open_page: Callable[..., Page], pubnub: PubNubStandIn
) -> None:
    answers: dict[str, Any] = {
        "robots": lambda _: {"robots": REGISTERED},
        "vehicles": lambda _: {"vehicles": {}},
        "streams": lambda _: {"streams": []},
    }
    told: dict[str, Any] = {"subscribe_key": SUBSCRIBE_KEY, "origin": pubnub.origin, "tls": False}
    with PageServer(namespace="iort", answers=answers, **told) as server:
        page = open_page(server.url, timezone_id="UTC")
        absent = page.locator("[data-absent]")
        until(lambda: absent.count() == 3, "the cars that are away")
        assert "Waiting for a car" in page.inner_text("#empty")
        assert absent.all_inner_texts() == [
            "car-2 offline since Tue 14 Nov 22:13:20 UTC",
            "car-3 connected, and sends nothing live",
            "car-10 never connected",
        ]
        Car(pubnub, "car-3").send()
        until(lambda: absent.count() == 2, "one to be heard")
        assert page.locator("[data-robot=car-3]").is_visible()
        # The car's view and the list both link to the history.
        page.goto(f"{server.url}#/car/car-2")
        past = page.get_by_role("link", name="What it did before")
        until(past.is_visible, "the link to the history")
        past.click()
        until(lambda: page.inner_text(".history .car-name") == "car-2", "the past")
        page.goto(f"{server.url}#/")
        absent.get_by_role("link", name="car-2").click()
        until(lambda: "#/history/car-2" in page.url, "the past again")


def test_a_page_without_a_server_lists_no_absent_car(page: Page, url: str) -> None:
    assert not page.get_by_role("link", name="What it did before").is_visible()
    page.goto(f"{url}#/")
    assert not page.locator(".absent").is_visible()
