"""The emergency stop with an overloaded server, with one that does not answer, and of a car that moves."""

from __future__ import annotations

import threading

import pytest

from testkit.waiting import GUARD_S, until
from tests.browser import show
from tests.web.cars import Car
from tests.web.lab import WHY_NOT, Lab, history

PHONE = {"viewport": {"width": 390, "height": 844}, "has_touch": True, "is_mobile": True}
_RANGES = [f"car-1/2026-05-04T1{i}:00:00.000Z/2026-05-04T1{i}:01:00.000Z" for i in range(6)]
COMPARE = f"#/compare?runs={','.join(_RANGES)}"


class Held(Lab):
    """A lab that holds its history, and its stops, until they are let go."""

    def __init__(self):
        super().__init__()
        self.past, self.stops = threading.Event(), threading.Event()
        self.stops.set()
        # Requests for the history that are held.
        self.reading = 0
        self.pressed = []

    def stop(self, asked):
        self.pressed.append(asked)
        assert self.stops.wait(GUARD_S)
        return super().stop(asked)

    def answers(self):
        return {**super().answers(), "history": self._history}

    def _history(self, asked):
        self.reading += 1
        assert self.past.wait(GUARD_S)
        return history(asked)


@pytest.fixture
def lab():
    lab = Held()
    yield lab
    lab.past.set()
    lab.stops.set()


# What is said between two presses.
PRESS_TWICE = """() => {
  const press = document.querySelector(".stop-press");
  press.click();
  const said = document.querySelector(".stop-sent").innerText;
  press.click();
  return said;
}"""


@pytest.mark.parametrize("tabs", [1, 3])
def test_a_stop_passes_every_answer_that_the_tabs_of_a_browser_wait_for(open_page, lab, server, tabs):
    page = open_page(server.invitation())
    for _ in range(tabs - 1):
        page.context.new_page().goto(server.url + COMPARE)
    page.goto(server.url + COMPARE)
    until(lambda: lab.reading >= 4, "the history to be asked for")
    page.get_by_role("button", name="Stop all").click()
    until(lambda: lab.pressed, "the stop to arrive")
    words = page.locator(".stop-words")
    until(lambda: words.inner_text().startswith("Emergency stop: car-1, car-9 stand."), "the cars' word")
    # They wait for a place, in whichever tab.
    assert lab.reading == 4
    lab.past.set()
    until(lambda: lab.reading >= 6 * tabs, "every range to be asked for")
    page.locator(".compare-view .charts canvas").first.wait_for()


def test_a_press_is_shown_at_once_and_what_to_do_without_an_answer(open_page, lab, server, car):
    page = open_page(server.invitation("#/car/car-1"))
    show(page, car.send())
    page.get_by_role("button", name="Take the wheel").wait_for()
    lab.stops.clear()
    sent = page.locator(".stop-sent")
    press = page.get_by_role("button", name="Stop car-1")
    lab.past.set()
    # Twice within a second, also on a busy machine.
    assert page.evaluate(PRESS_TWICE) == "Stop sent to car-1 …"
    late = "No answer after 1.0 s: car-1 may not have"
    until(lambda: sent.inner_text().startswith(late), "the end of a second")
    for advice in ("Press again, and use the switch on the car.", "within 0.5 s of the last one"):
        assert advice in sent.inner_text()
    # The second press was within the second; a third is sent.
    until(lambda: lab.pressed, "the first press to arrive")
    assert len(lab.pressed) == 1
    press.click()
    until(lambda: len(lab.pressed) == 2, "another stop")
    lab.stops.set()
    page.locator(".stop-words").filter(has_text="Emergency stop: car-1 stands.").wait_for()
    sent.wait_for(state="hidden")


def test_a_server_that_is_gone_has_stopped_nothing(open_page, server):
    page = open_page(server.invitation())
    page.locator(".stop-press").wait_for()
    server.stop()
    page.get_by_role("button", name="Stop all").click()
    said = page.locator(".stop-sent").filter(
        has_text="NOTHING WAS STOPPED: The page's server does not answer."
    )
    said.filter(has_text="use the switch on the car").wait_for()


def test_a_car_that_does_not_stand_is_named_before_and_after_a_stop(open_page, lab, server, pubnub):
    lab.unstoppable.add("car-9")
    page = open_page(server.invitation())
    for name in ("car-1", "car-9"):
        show(page, Car(pubnub, name).send())
    unable, moves, words = (page.locator(f".stop-{name}") for name in ("unable", "moves", "words"))
    until(lambda: unable.inner_text() == f"The stop does not stop: car-9 ({WHY_NOT}).", "the warning")
    card = page.locator("[data-robot=car-9]")
    until(lambda: card.get_attribute("data-stop") == "unable", "the card's warning")
    lab.confirms = False
    page.get_by_role("button", name="Stop all").click()
    until(lambda: "car-1 (not confirmed)" in moves.inner_text(), "the car that has not confirmed it")
    until(lambda: f"car-9 ({WHY_NOT})" in moves.inner_text(), "the car that cannot be stopped")
    lab.cars["car-1"][1] = True
    until(lambda: words.inner_text() == "Emergency stop: car-1 stands.", "the word of the other car")
    assert moves.inner_text() == f"NOT standing: car-9 ({WHY_NOT})."
    until(lambda: f"does NOT stand: {WHY_NOT}" in card.inner_text(), "the card's word")
    until(lambda: "stands: emergency stop" in page.inner_text("[data-robot=car-1]"), "the other's")
    # Nothing red says that it stands.
    red, yellow = (
        page.evaluate("(node) => getComputedStyle(node).backgroundColor", page.locator(at).element_handle())
        for at in (".stop-stands", ".stop-moves")
    )
    assert red != yellow
    # A car that was released alone is named, too.
    lab.cars["car-9"] = [True, True]
    lab.unstoppable.clear()
    lab.cars["car-1"] = [False, False]
    page.evaluate("document.dispatchEvent(new Event('visibilitychange'))")
    until(lambda: moves.inner_text() == "NOT standing: car-1 (it was not asked to stop).", "the released car")


@pytest.mark.parametrize("options", [{}, PHONE], ids=["desktop", "phone"])
def test_the_stop_its_words_and_the_speed_stay_in_sight(open_page, server, car, options):
    page = open_page(server.invitation("#/car/car-1"), **options)
    show(page, car.send())
    page.get_by_role("button", name="Stop car-1").click()
    page.locator(".stop-words").filter(has_text="stands").wait_for()
    page.evaluate("scrollTo(0, document.documentElement.scrollHeight)")
    assert page.evaluate("scrollY") > 0
    for place in (".stop-press", ".stop-words", ".stop-release", "#speed-now"):
        box = page.locator(place).bounding_box()
        assert box
        assert box["y"] >= 0, place
        assert box["y"] + box["height"] <= page.viewport_size["height"], place
    assert "m/s" in page.inner_text("#speed-now")
