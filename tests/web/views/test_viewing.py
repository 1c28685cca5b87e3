"""What the page asks of the cars: leases on what is on the screen, and nothing while nobody looks."""

from __future__ import annotations

import threading
from typing import TYPE_CHECKING, Any

import pytest

from iort_contract.limits import LIVE_MAX_RATE_HZ
from iort_contract.messages.viewing import VIEW_LEASE_MS, VIEW_RENEW_S
from iort_station.page.server import PageServer
from testkit.waiting import GUARD_S, until
from tests.browser import show
from tests.web.cars import SUBSCRIBE_KEY, Car

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping

    from playwright.sync_api import Page

    from local.pubnub.standin import PubNubStandIn

HIDE = """(hidden) => {
  Object.defineProperty(document, "hidden", { value: hidden, configurable: true });
  document.dispatchEvent(new Event("visibilitychange"));
}"""

# The states of a car until it is stale, and how long it has been silent then.
UNTIL_STALE = """() => new Promise((done) => {
  const states = [];
  const look = () => {
    const { state, silent_s } = iort.robots["car-1"];
    states.push(state);
    if (["stale", "gone"].includes(state)) done([states, silent_s]);
    else setTimeout(look, 20);
  };
  look();
})"""
NO_RENEWAL = f"""const every = setInterval;
window.setInterval = (call, ms) => ms === {VIEW_RENEW_S * 1000:.0f} ? 0 : every(call, ms);"""


class Leases:
    """Keeps what the page's server was asked for."""

    def __init__(self) -> None:
        self.asked: list[Mapping[str, str]] = []
        # The ends of leases wait for it.
        self.ends = threading.Event()
        self.ends.set()

    def view(self, asked: Mapping[str, str]) -> dict[str, Any]:
        if asked["lease_ms"] == "0":
            assert self.ends.wait(GUARD_S)
        self.asked.append(asked)
        return {"asked": asked["robots"].count(",") + 1}

    def held(self) -> dict[str, float]:
        """The highest rate of each robot with a lease."""
        held: dict[tuple[str, str], float] = {}
        for asked in list(self.asked):
            for robot in asked["robots"].split(","):
                held.pop((robot, asked["viewer"]), None)
                if asked["lease_ms"] != "0":
                    held[robot, asked["viewer"]] = float(asked["rate_hz"])
        return {robot: rate_hz for (robot, _), rate_hz in sorted(held.items(), key=lambda one: one[1])}


@pytest.fixture
def leases() -> Leases:
    return Leases()


@pytest.fixture
def served(pubnub: PubNubStandIn, leases: Leases) -> Iterator[str]:
    told: dict[str, Any] = {"subscribe_key": SUBSCRIBE_KEY, "origin": pubnub.origin, "tls": False}
    presence = {"online": True, "since_ms": 0}
    answers = {
        "robots": lambda _: {"robots": {"car-99": presence, "car-98": {**presence, "online": False}}},
        "tags": lambda _: {"tags": {}},
        "vehicles": lambda _: {"vehicles": {}},
    }
    with PageServer(namespace="iort", answers=answers, open_actions={"view": leases.view}, **told) as server:
        yield server.url


def test_the_page_holds_what_is_on_the_screen_and_nothing_while_hidden_or_closed(
    open_page: Callable[..., Page], pubnub: PubNubStandIn, served: str, leases: Leases
) -> None:
    page = open_page(served, viewport={"width": 700, "height": 400})
    # It is connected, and has not been heard.
    until(lambda: leases.held() == {"car-99": 1.0}, "a look at the registered car")
    for number in range(20):
        show(page, Car(pubnub, f"car-{number}").send())
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


def test_an_idle_car_is_not_stale_and_is_gone_when_it_breaks_its_word(page: Page, car: Car) -> None:
    show(page, car.send(next_ms=60_000))
    until(lambda: page.get_attribute("#car", "data-state") == "idle", "the car to be idle")
    assert "idle: newest values are" in page.inner_text(".car-state")
    assert page.inner_text("#count") == "1 idle"
    assert "cannot wake cars" in page.inner_text(".foot")
    show(page, car.send(next_ms=4_000))
    states, silent_s = page.evaluate(UNTIL_STALE)
    assert set(states) - {"live"} == {"idle", "stale"}
    assert silent_s >= 5.4
    # The promise of ten a second.
    show(page, car.send(next_ms=100))
    _, silent_s = page.evaluate(UNTIL_STALE)
    assert silent_s < 5.4
    car.send(next_ms=10**6)
    until(lambda: page.evaluate("iort.malformed") == 1, "a time that no car may say")


def test_a_car_that_is_looked_at_again_is_held_though_the_end_arrives_late(
    open_page: Callable[..., Page], served: str, leases: Leases
) -> None:
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
