"""The fleet's cards and a car's board, in a browser."""

from __future__ import annotations

import itertools

import pytest

from iort_agent.sources.sim.driver import HALL
from iort_contract.catalog.streams import LOG_STREAM, POSE_STREAM
from testkit.waiting import until
from tests.browser import drawn, plain, show, shown
from tests.web.cars import GAIN, SAMPLE, Car
from tests.web.lab import past

OFF_MS = 1_700_000_000_000
REGISTERED = {
    "car-10": {"online": False, "since_ms": None},
    "car-2": {"online": False, "since_ms": OFF_MS},
    "car-3": {"online": True, "since_ms": OFF_MS},
}
TAGS = {"car-1": {"lab": "north"}, "car-2": {"lab": "south", "team": "blue"}, "car-10": {"lab": "north"}}


@pytest.fixture
def vehicles():
    return {}


@pytest.fixture
def served(serve, vehicles):
    answers = {
        "robots": lambda _: {"robots": REGISTERED},
        "tags": lambda _: {"tags": TAGS},
        "vehicles": lambda _: {"vehicles": vehicles},
        "streams": lambda _: {"streams": []},
        "history": lambda _: past([], {}),
    }
    return serve(answers=answers).url


def test_cars_that_are_not_heard_are_listed_until_they_send(open_page, pubnub, served):
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
    # A car that is off is told from one that is not known.
    page.goto(f"{served}#/car/car-2")
    until(lambda: page.inner_text("#empty-title") == "car-2 is offline", "the car's state")
    assert "Offline since Tue 14 Nov 22:13:20 UTC. It appears" in page.inner_text("#empty")
    assert page.get_by_role("link", name="What it did before").is_visible()
    page.goto(f"{served}#/car/car-22")
    until(lambda: page.inner_text("#empty-title") == "There is no car car-22", "the refusal")
    assert "Registered: car-2, car-3, car-10." in page.inner_text("#empty")


def test_a_car_registered_after_the_page_opened_shows_metres_per_second(open_page, pubnub, served, vehicles):
    page = open_page(f"{served}#/car/car-2")
    car, speed = Car(pubnub, "car-2"), page.locator(".gauge").first
    show(page, car.send())
    assert "15\u202f000" in speed.inner_text()
    vehicles["car-9"] = vehicles["car-2"] = {"speed_to_erpm_gain": GAIN}
    new = (Car(pubnub, f"car-{number}") for number in itertools.count(9))

    def learnt():
        # A car that is new while a question is on its way asks none of its own.
        next(new).send()
        return "m/s" in speed.inner_text()

    until(learnt, "metres a second")
    # The bar's ends are in metres a second, too.
    until(lambda: speed.locator(".gauge-scale").inner_text().split() == ["\u22123", "4"], "the new ends")


def test_the_fleet_is_sorted_and_usable_by_keyboard(page, car, url):
    page.goto(f"{url}#/")
    fleet = {name: Car(car.pubnub, name) for name in ("car-10", "car-2", "car-1")}
    for name, each in fleet.items():
        show(page, each.send({**SAMPLE, "voltage_input": int(name[4:])}))
    cards = page.locator("[data-robot]")
    assert [cards.nth(i).get_attribute("data-robot") for i in range(3)] == ["car-1", "car-2", "car-10"]
    until(lambda: "10.0" in cards.nth(2).inner_text(), "the card's values")

    def all_online():
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

    def left():
        # A busy browser may take the key for its own, which stops what loads.
        page.keyboard.press("Escape")
        return page.url == f"{url}#/"

    until(left, "the fleet again")


def test_cars_are_found_sorted_and_grouped_and_the_address_says_so(open_page, pubnub, served):
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


DEFAULT = ["speed", "battery", "currents", "duty", "speed-current", "g-g", "trajectory", "delay"]
TITLES = "[...document.querySelectorAll('#car .board .charts > :not([hidden])')].map((e) => e.ariaLabel)"


class Recorded:
    """A server with a row each 0.1 s of the past; it keeps what was asked."""

    def __init__(self):
        self.asked_s = []

    def history(self, asked):
        first, last = (int(asked[name]) / 1e6 for name in ("from_us", "to_us"))
        if asked["stream"] == LOG_STREAM:
            line = {"level": "warning", "logger": "iort_agent.mqtt", "text": "connection lost", "left_out": 0}
            return past([last - 60], {name: [value] for name, value in line.items()})
        self.asked_s.append((first, last))
        times = [first + i / 10 for i in range(int((last - first) * 10))]
        return past(times, {"voltage_input": [10.0] * len(times), "frame": ["map"] * len(times)}, row_s=0.1)


@pytest.fixture
def recorded():
    return Recorded()


@pytest.fixture
def board(serve, recorded):
    answers = {
        "history": recorded.history,
        "vehicles": lambda _: {"vehicles": {}},
        "robots": lambda _: {"robots": {}},
        "streams": lambda _: {"streams": [LOG_STREAM]},
    }
    return serve(answers=answers, track=HALL).url


def rows(page):
    return int(page.evaluate("iort.robots['car-1'].streams.vesc.kept.rows"))


def test_charts_begin_with_what_was_recorded(open_page, board, recorded, car):
    page = open_page(f"{board}#/car/car-1?window=300&charts=battery")
    show(page, car.send())
    until(lambda: rows(page) > 2900, "the last five minutes")
    chart = page.locator("section[aria-label='Battery voltage'] .plot")
    chart.hover()
    until(lambda: "min ago" in page.inner_text("section[aria-label='Battery voltage'] .note"), "a past value")
    assert plain(page.inner_text("[data-reading=voltage_input]")) == "10.00"
    first_s, last_s = recorded.asked_s[0]
    # A busy machine asks some time after the message came.
    assert 240 < last_s - first_s <= 301
    # A longer window asks for the rest only.
    page.select_option("[name=window]", "1800")
    until(lambda: rows(page) > 17_000, "half an hour")
    begin_s, end_s = max(recorded.asked_s, key=lambda span: span[1] - span[0])
    # What was there already is not asked for again.
    assert first_s - 1 <= end_s <= begin_s + 1500 + 1
    # What is kept for the longest window is given back with the car.
    page.keyboard.press("Escape")
    until(lambda: rows(page) < 1000, "the fleet's view to need less")


def test_the_viewers_charts_are_kept_and_shared(open_page, page, car, url):
    show(page, car.send())
    titles = "Speed, Battery voltage, Current, Duty cycle, Speed and motor current, Delay of each message"
    first = titles.split(", ")
    assert page.evaluate(TITLES) == first
    page.get_by_label("Close Duty cycle").click()
    page.get_by_label("Move Delay").focus()
    for _ in range(len(first) - 2):
        page.keyboard.press("ArrowLeft")
    page.select_option("[name=window]", "60")
    page.locator("[name=chart]").focus()
    page.select_option("[name=chart]", "vesc/temperature_pcb")
    show(page, car.send())
    mine = ["Delay of each message", *first[:3], first[4], "Board temperature"]
    assert page.evaluate(TITLES) == mine
    charts = ["delay", *DEFAULT[:3], *DEFAULT[4:-1], "vesc/temperature_pcb"]
    assert page.url == f"{url}#/car/car-1?window=60&charts={','.join(charts)}"
    # Another browser shows the same by the address, this one without it.
    other = open_page(page.url)
    show(other, car.send())
    assert other.evaluate(TITLES) == mine
    # A reload could come before an address of the same document.
    page.goto("about:blank")
    page.goto(f"{url}#/car/car-1")
    until(lambda: page.evaluate("window.iort?.link") == "live", "the page to connect")
    show(page, car.send())
    assert page.evaluate(TITLES) == mine
    page.get_by_role("button", name="Reset").click()
    drawn(page)
    assert page.evaluate(TITLES) == first
    assert page.url == f"{url}#/car/car-1"


def test_the_agents_log_lines_are_shown_and_those_of_the_last_hour(open_page, board, car):
    page = open_page(f"{board}#/car/car-1")
    line = {"level": "error", "logger": "iort_agent.sources", "text": "source vesc failed: OSError: gone"}
    show(page, car.send({**line, "left_out": 2}, stream=LOG_STREAM))
    lines = page.get_by_label("Agent's log").locator("li")
    until(lambda: lines.count() == 2, "both lines")
    told = "source vesc failed: OSError: gone 2 lines before were left out"
    assert lines.nth(0).inner_text().splitlines()[1:] == [told]
    assert "connection lost" in lines.nth(1).inner_text()
    # Their texts are no tiles.
    assert page.locator(f"[data-stream={LOG_STREAM}]").count() == 0


def test_the_trajectory_is_drawn_on_the_track(open_page, board, car):
    page = open_page(f"{board}#/car/car-1?charts=trajectory")
    painted = """() => {
      const canvas = document.querySelector(".panel.xy canvas");
      const { data } = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height);
      return data.filter((value, i) => i % 4 === 3 && value > 0).length;
    }"""
    # Far from the track, the pose is of another map, and the track is left out.
    show(page, car.send({"x": 1e4, "y": 1e4, "heading": 0.0}, stream=POSE_STREAM))
    until(lambda: page.evaluate(painted) > 0, "the pose")
    alone = page.evaluate(painted)
    page = open_page(page.url)
    show(page, car.send({"x": HALL.x_m[0], "y": HALL.y_m[0], "heading": 0.0}, stream=POSE_STREAM))
    until(lambda: page.evaluate(painted) > 2 * alone, "the track")


def test_a_chart_is_dragged_to_another_place(page, car):
    show(page, car.send(SAMPLE))
    page.get_by_label("Move Speed", exact=True).hover()
    page.mouse.down()
    other = page.locator("section[aria-label='Battery voltage']").bounding_box()
    assert other
    page.mouse.move(other["x"] + other["width"] / 2, other["y"] + other["height"] / 2)
    page.mouse.up()
    assert page.evaluate(TITLES)[:2] == ["Battery voltage", "Speed"]
    assert "charts=battery,speed,currents" in page.url


def test_the_charts_keep_their_height_when_something_opens_beside_them(open_page, server, car):
    page = open_page(server.invitation("#/car/car-1"))
    show(page, car.send())
    height = "() => document.querySelector('.board .charts').offsetHeight"
    before = page.evaluate(height)
    page.get_by_role("heading", name="Settings").click()
    page.locator(".setting").first.wait_for()
    assert page.evaluate(height) == before
