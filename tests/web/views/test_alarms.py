"""The alarms in a real browser: the badge, what to do, where to look, and who has seen it."""

from __future__ import annotations

from typing import TYPE_CHECKING

from iort_contract.catalog.metrics import METRICS
from testkit.waiting import until
from tests.browser import show
from tests.web.cars import SAMPLE, Car
from tests.web.lab import NOW_S, VIEWS, Lab

if TYPE_CHECKING:
    from collections.abc import Callable

    from playwright.sync_api import Page

    from local.pubnub.standin import PubNubStandIn


def test_every_view_counts_the_alarms_and_each_says_what_to_do(
    open_page: Callable[..., Page], pubnub: PubNubStandIn
) -> None:
    lab = Lab()
    with lab.server(pubnub) as server:
        page = open_page(server.url)
        badge = page.locator("#alarms")
        for view, (address, _) in VIEWS.items():
            page.goto(server.url + address)
            until(lambda: badge.inner_text() == "3", f"the badge on the view {view}")
        assert badge.get_attribute("aria-label") == "3 raised, 2 of them not acknowledged"
        page.locator("#to-alarms").click()
        faulty = page.locator("[data-alarm=FaultSamples]")
        until(faulty.count, "the alarm")
        entry = METRICS["FaultSamples"].alarm
        assert entry
        assert entry.advice.replace("`", "") in faulty.inner_text()
        # The moment in the past of the cars that the alert named, and of a refused message's car.
        links = faulty.locator("a")
        assert links.all_inner_texts() == ["car-1", "car-2"]
        address = links.first.get_attribute("href") or ""
        assert address.startswith("#/history/car-1?from=20")
        message = page.locator("[data-alarm=Quarantined] .cases")
        until(message.count, "the messages in quarantine")
        assert "column speed must have 10 values" in message.inner_text()
        assert "iort errors 0a1b2c" in message.inner_text()
        page.locator("#acknowledge-as").fill("grace")
        faulty.locator("button").click()
        until(lambda: "Acknowledged by grace" in faulty.inner_text(), "the acknowledgement")
        assert lab.asked == [
            {"alarm": "FaultSamples", "since_ms": str(round((NOW_S - 600) * 1000)), "by": "grace"}
        ]
        assert faulty.locator("button").count() == 0
        # It comes back: it is new again.
        lab.alarms[0] = {**lab.alarms[0], "since_s": NOW_S, "acknowledged": None}
        page.reload()
        until(lambda: faulty.locator("button").count() == 1, "the button")
        assert page.locator("#acknowledge-as").input_value() == "grace"


def test_live_values_raise_the_alarms_of_cars(open_page: Callable[..., Page], pubnub: PubNubStandIn) -> None:
    lab = Lab()
    lab.alarms = [{**one, "state": "OK"} for one in lab.alarms]
    with lab.server(pubnub) as server:
        page = open_page(f"{server.url}#/alarms")
        until(lambda: "not raised" in page.inner_text(".quiet"), "the cloud's alarms")
        assert page.locator("#alarms").is_hidden()
        # The threshold is the deployment's.
        bad = {**SAMPLE, "fault_code": 2, "temperature_pcb": 80.5, "voltage_input": 10.6}
        show(page, Car(pubnub).send(bad))
        until(lambda: page.inner_text("#alarms") == "2", "the badge")
        raised = page.locator("[data-alarm]")
        assert {raised.nth(i).get_attribute("data-alarm") for i in range(2)} == {
            "FaultSamples",
            "TemperatureDegC",
        }
        words = page.inner_text("[data-alarm=FaultSamples] li").split("\n")
        assert words[:2] == ["car-1", "under voltage (2)"]
        # Without an answer nobody knows.
        lab.refuses = True
        page.reload()
        until(lambda: page.inner_text("#alarms") == "?", "the badge without a number")
        until(lambda: "no such right" in page.inner_text(".history-note"), "the reason")
        assert page.locator("text=No alarm is raised").is_hidden()
