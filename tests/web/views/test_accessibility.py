"""Every view is usable without sight, without a mouse, with little contrast vision, and with a thumb."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import pytest

from iort_contract.catalog.streams import LOG_STREAM
from testkit.waiting import until
from tests.browser import drawn, plain, show
from tests.web.cars import SAMPLE, Car
from tests.web.lab import VIEWS, Lab

if TYPE_CHECKING:
    from collections.abc import Callable

    from playwright.sync_api import Page

    from local.pubnub.standin import PubNubStandIn

AXE = Path(__file__).parents[3] / "node_modules" / "axe-core" / "axe.min.js"
DESKTOP = {"viewport": {"width": 1280, "height": 900}}
PHONE = {"viewport": {"width": 390, "height": 844}, "has_touch": True, "is_mobile": True}
RULES = ["wcag2a", "wcag2aa", "wcag21a", "wcag21aa", "wcag22aa", "best-practice"]
# What a finger can hit, in CSS pixels; links within a text are as high as the text.
TARGET_PX = 44
SMALL = """(least) => [...document.querySelectorAll("a, button, input, select, summary, [tabindex='0']")]
  .filter((node) => node.checkVisibility() && getComputedStyle(node).display !== "inline")
  .map((node) => [node, (node.closest("label:has([type=checkbox])") ?? node).getBoundingClientRect()])
  .filter(([_, { width, height }]) => width < least - 0.5 || height < least - 0.5)
  .map(([node, { width, height }]) => `${width} x ${height}: ${node.outerHTML.slice(0, 90)}`)"""

BEYOND = "document.documentElement.scrollWidth - document.documentElement.clientWidth"


def violations(page: Page) -> list[str]:
    """What axe finds with everything unfolded: the rule, the place and the reason."""
    page.evaluate("() => document.querySelectorAll('details').forEach((each) => { each.open = true; })")
    drawn(page)
    found = page.evaluate(
        "(tags) => axe.run(document, { runOnly: tags, resultTypes: ['violations'] })", RULES
    )
    return [
        f"{rule['id']}: {node['target']} {node['failureSummary']}"
        for rule in found["violations"]
        for node in rule["nodes"]
    ]


def silent(page: Page, car: Car, state: str) -> int:
    """Whether a car that has sent is stale or gone; on a slow machine a car that is gone sends again."""
    if state == "stale" and page.locator("[data-state=gone]").count():
        show(page, car.send({**SAMPLE, "fault_code": 2}))
    return page.locator(f"[data-state={state}]").count()


@pytest.mark.parametrize("theme", ["dark", "light"])
@pytest.mark.parametrize("device", [DESKTOP, PHONE], ids=["desktop", "phone"])
def test_every_view_is_accessible(
    open_page: Callable[..., Page],
    pubnub: PubNubStandIn,
    theme: Literal["dark", "light"],
    device: dict[str, Any],
) -> None:
    found = {}
    with Lab().server(pubnub) as server:
        page = open_page(server.invitation(), color_scheme=theme, reduced_motion="reduce", **device)
        page.evaluate(AXE.read_text())
        car = Car(pubnub)
        show(page, car.send({**SAMPLE, "fault_code": 2}))
        for view, (address, filled) in VIEWS.items():
            page.goto(server.url + address)
            show(page, car.send({**SAMPLE, "fault_code": 2}))
            page.locator(filled).first.wait_for()
            if view == "car":
                line = {
                    "level": "error",
                    "logger": "iort_agent",
                    "text": "failed\nwith details",
                    "left_out": 1,
                }
                show(page, car.send(line, stream=LOG_STREAM))
                page.get_by_role("heading", name="Settings").click()
                page.locator(".setting").first.wait_for()
                page.get_by_role("button", name="Take the wheel").click()
                page.get_by_text("The role of a driver cannot be assumed").wait_for()
            found[view] = violations(page)
            if device is PHONE:
                found[f"{view}, by thumb"] = page.evaluate(SMALL, TARGET_PX)
                found[f"{view}, sideways"] = page.evaluate(BEYOND)
        if device is DESKTOP:
            # Old values are readable, too.
            page.goto(server.url + VIEWS["car"].address)
            show(page, car.send({**SAMPLE, "fault_code": 2}))
            for view, state in (("car", "stale"), ("fleet", "gone"), ("car", "gone")):
                page.goto(server.url + VIEWS[view].address)
                until(lambda state=state: silent(page, car, state), f"{view} to be {state}")
                found[f"{view}, {state}"] = violations(page)
    assert {view: faults for view, faults in found.items() if faults} == {}


def test_a_card_outside_the_screen_has_a_name(page: Page, car: Car, url: str) -> None:
    page.goto(f"{url}#/")
    names = [f"car-{i}" for i in range(40)]
    for name in names:
        show(page, Car(car.pubnub, name).send())
    until(lambda: page.locator(".card").count() == len(names), "the cards")
    nodes = page.context.new_cdp_session(page).send("Accessibility.getFullAXTree")["nodes"]
    links = [node["name"]["value"] for node in nodes if node.get("role", {}).get("value") == "link"]
    assert [name for name in names if not any(name in link for link in links)] == []
    assert "" not in links


def test_a_chart_is_told_in_words_and_has_a_cursor_for_arrow_keys(page: Page, car: Car) -> None:
    for volts in (11.0, 12.5, 11.75):
        show(page, car.send({**SAMPLE, "voltage_input": volts}))
    chart = page.locator("[role=img][aria-label^='Chart Battery voltage']")
    figures = "newest 11.75 V, minimum 11.00 V, maximum 12.50 V"
    until(lambda: figures in (chart.get_attribute("aria-label") or ""), "the figures")
    spoken, reading = page.locator("#spoken"), page.locator("[data-reading=voltage_input]")
    chart.focus()
    page.keyboard.press("ArrowLeft")
    until(lambda: spoken.inner_text().endswith(" s ago: 11.75 V"), "the newest value")

    def at(keys: str, volts: str) -> bool:
        # The chart moves on below a cursor that stays.
        for key in keys.split():
            page.keyboard.press(key)
        return spoken.inner_text().endswith(f" s ago: {volts} V") and reading.inner_text() == volts

    for keys, volts in (("End Shift+ArrowLeft", "12.50"), ("Home", "11.00"), ("End", "11.75")):
        until(lambda keys=keys, volts=volts: at(keys, volts), f"{volts} V, spoken and as a figure")
    # The keys moved the cursor, and not to another car.
    page.keyboard.press("Escape")
    until(lambda: spoken.inner_text() == "", "the cursor to be gone")
    assert page.url.endswith("#/car/car-1")


def test_a_chart_of_the_past_is_told_in_words_and_has_a_cursor_for_arrow_keys(
    open_page: Callable[..., Page], pubnub: PubNubStandIn
) -> None:
    with Lab().server(pubnub) as server:
        page = open_page(server.url + VIEWS["history"].address)
        chart = page.locator("[role=img][aria-label^='Chart Battery voltage']")
        extent = f"minimum -{SAMPLE['voltage_input']} V, maximum {SAMPLE['voltage_input']} V"
        until(lambda: extent in plain(chart.get_attribute("aria-label") or ""), "the figures")
        chart.focus()
        page.keyboard.press("Home")
        until(lambda: page.inner_text("#spoken").endswith(": 0.00 V"), "the first value")
        page.keyboard.press("Shift+ArrowRight")
        until(lambda: page.inner_text("#spoken").endswith(": 1.29 V"), "the second value")
        assert page.inner_text("[data-reading=voltage_input]") == "1.29"
