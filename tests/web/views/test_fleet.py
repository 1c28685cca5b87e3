"""The fleet's view: cards in order, found and grouped; cars that are not heard; and all of it by keyboard."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any

import pytest

from iort_station.page.server import PageServer
from testkit.waiting import until
from tests.browser import show, shown
from tests.web.cars import GAIN, SAMPLE, SUBSCRIBE_KEY, Car

if TYPE_CHECKING:
    from playwright.sync_api import Page

    from local.pubnub.standin import PubNubStandIn

OFF_MS = 1_700_000_000_000
REGISTERED = {
    "car-10": {"online": False, "since_ms": None},
    "car-2": {"online": False, "since_ms": OFF_MS},
    "car-3": {"online": True, "since_ms": OFF_MS},
}
TAGS = {"car-1": {"lab": "north"}, "car-2": {"lab": "south", "team": "blue"}, "car-10": {"lab": "north"}}


@pytest.fixture
def vehicles() -> dict[str, Any]:
    return {}


@pytest.fixture
def served(pubnub: PubNubStandIn, vehicles: dict[str, Any]) -> Iterator[str]:
    answers: dict[str, Any] = {
        "robots": lambda _: {"robots": REGISTERED},
        "tags": lambda _: {"tags": TAGS},
        "vehicles": lambda _: {"vehicles": vehicles},
        "streams": lambda _: {"streams": []},
        "history": lambda _: {
            "times_s": [],
            "fields": {},
            "samples": 0,
            "ros2": False,
            "archive": None,
            "row_s": 0,
        },
    }
    told: dict[str, Any] = {"subscribe_key": SUBSCRIBE_KEY, "origin": pubnub.origin, "tls": False}
    with PageServer(namespace="iort", answers=answers, **told) as server:
        yield server.url


def test_cars_that_are_not_heard_are_listed_until_they_send(
    open_page: Callable[..., Page], pubnub: PubNubStandIn, served: str
) -> None:
    page = open_page(served, timezone_id="UTC")
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
    assert not absent.first.is_visible()
    page.get_by_text("Not heard: 2 cars").click()
    absent.get_by_role("link", name="car-2").click()
    until(lambda: page.inner_text(".history .car-name") == "car-2", "the past")


def test_an_offline_car_is_told_from_an_unknown_one(open_page: Callable[..., Page], served: str) -> None:
    page = open_page(f"{served}#/car/car-2", timezone_id="UTC")
    until(lambda: page.inner_text("#empty-title") == "car-2 is offline", "the car's state")
    assert "Offline since Tue 14 Nov 22:13:20 UTC. It appears" in page.inner_text("#empty")
    assert page.get_by_role("link", name="What it did before").is_visible()
    page.goto(f"{served}#/car/car-22")
    until(lambda: page.inner_text("#empty-title") == "There is no car car-22", "the refusal")
    assert "Registered: car-2, car-3, car-10." in page.inner_text("#empty")


def test_a_page_without_a_server_lists_no_absent_car(page: Page, url: str) -> None:
    assert not page.get_by_role("link", name="What it did before").is_visible()
    page.goto(f"{url}#/")
    assert not page.locator(".offline").is_visible()


def test_a_car_registered_after_the_page_opened_shows_metres_per_second(
    open_page: Callable[..., Page], pubnub: PubNubStandIn, served: str, vehicles: dict[str, Any]
) -> None:
    page = open_page(f"{served}#/car/car-2")
    car, speed = Car(pubnub, "car-2"), page.locator(".gauge").first
    show(page, car.send())
    assert "15\u202f000" in speed.inner_text()
    vehicles["car-9"] = vehicles["car-2"] = {"speed_to_erpm_gain": GAIN}
    Car(pubnub, "car-9").send()
    until(lambda: "m/s" in speed.inner_text(), "metres a second")
    # The bar's ends are in metres a second, too.
    until(lambda: speed.locator(".gauge-scale").inner_text().split() == ["\u22123", "4"], "the new ends")


def test_the_fleet_is_sorted_and_usable_by_keyboard(page: Page, car: Car, url: str) -> None:
    page.goto(f"{url}#/")
    fleet = {name: Car(car.pubnub, name) for name in ("car-10", "car-2", "car-1")}
    for name, each in fleet.items():
        show(page, each.send({**SAMPLE, "voltage_input": int(name[4:])}))
    cards = page.locator("[data-robot]")
    assert [cards.nth(i).get_attribute("data-robot") for i in range(3)] == ["car-1", "car-2", "car-10"]
    until(lambda: "10.0" in cards.nth(2).inner_text(), "the card's values")

    def all_online() -> bool:
        # On a slow machine the first is silent when the last is shown.
        for name, each in fleet.items():
            each.send({**SAMPLE, "voltage_input": int(name[4:])})
        return page.inner_text("#count") == "3 online" and "online" in cards.nth(2).inner_text()

    until(all_online, "all cars to be online")
    # The first arrow key needs no card with the focus.
    page.keyboard.press("ArrowRight")
    assert page.evaluate("document.activeElement.dataset.robot") == "car-1"
    page.keyboard.press("ArrowRight")
    assert page.evaluate("document.activeElement.dataset.robot") == "car-2"
    page.keyboard.press("Enter")
    until(lambda: page.url == f"{url}#/car/car-2", "the car's own view")
    assert page.inner_text(".car-name") == "car-2"
    page.keyboard.press("ArrowRight")
    until(lambda: page.url.startswith(f"{url}#/car/car-10"), "the next car")
    until(lambda: shown(page, "voltage_input") == "10.00", "the car's own values")
    page.keyboard.press("Escape")
    until(lambda: page.url == f"{url}#/", "the fleet again")


def test_cars_are_found_sorted_and_grouped_and_the_address_says_so(
    open_page: Callable[..., Page], pubnub: PubNubStandIn, served: str
) -> None:
    page = open_page(served)
    for name, volts in (("car-1", 11.0), ("car-2", 9.0), ("car-10", 10.0)):
        show(page, Car(pubnub, name).send({**SAMPLE, "voltage_input": volts}))
    content = "[...document.querySelectorAll('#cars > *')].map((e) => e.dataset.robot ?? e.textContent)"
    page.select_option("[name=sort]", "battery")
    until(lambda: page.evaluate(content) == ["car-2", "car-10", "car-1"], "the lowest battery first")
    page.select_option("[name=group]", "lab")
    until(lambda: page.evaluate(content) == ["north2", "car-10", "car-1", "south1", "car-2"], "groups")
    page.keyboard.press("/")
    page.keyboard.type("car lab=north")
    until(lambda: page.evaluate(content) == ["north2", "car-10", "car-1"], "the cars of one laboratory")
    again = open_page(page.url)
    assert again.input_value("[name=find]") == "car lab=north"
    assert again.input_value("[name=sort]") == "battery"
    until(lambda: again.input_value("[name=group]") == "lab", "the group")
