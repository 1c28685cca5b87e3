"""A car's charts: their past, their window, and the viewer's own choice and order."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any

import pytest

from iort_agent.sources.sim.driver import HALL
from iort_contract.catalog.streams import LOG_STREAM, POSE_STREAM
from iort_station.page.server import PageServer
from testkit.waiting import until
from tests.browser import drawn, plain, show
from tests.web.cars import SAMPLE, SUBSCRIBE_KEY, Car
from tests.web.lab import Lab

if TYPE_CHECKING:
    from playwright.sync_api import Page

    from local.pubnub.standin import PubNubStandIn

DEFAULT = ["speed", "battery", "currents", "duty", "speed-current", "g-g", "trajectory", "delay"]
TITLES = "[...document.querySelectorAll('#car .board .charts > :not([hidden])')].map((e) => e.ariaLabel)"


class Recorded:
    """A server with a row each 0.1 s of the past; it keeps what was asked."""

    def __init__(self) -> None:
        self.asked_s: list[float] = []

    def history(self, asked: Any) -> dict[str, Any]:
        first, last = (int(asked[name]) / 1e6 for name in ("from_us", "to_us"))
        if asked["stream"] == LOG_STREAM:
            line = {"level": "warning", "logger": "iort_agent.mqtt", "text": "connection lost", "left_out": 0}
            fields = {name: {"mean": [value]} for name, value in line.items()}
            return {
                "times_s": [last - 60],
                "fields": fields,
                "samples": 1,
                "ros2": False,
                "archive": None,
                "row_s": 0,
            }
        self.asked_s.append(last - first)
        times = [first + i / 10 for i in range(int((last - first) * 10))]
        fields = {"voltage_input": {"mean": [10.0] * len(times)}, "frame": {"mean": ["map"] * len(times)}}
        return {
            "times_s": times,
            "fields": fields,
            "samples": len(times),
            "ros2": False,
            "archive": None,
            "row_s": 0.1,
        }


@pytest.fixture
def recorded() -> Recorded:
    return Recorded()


@pytest.fixture
def served(pubnub: PubNubStandIn, recorded: Recorded) -> Iterator[str]:
    answers: dict[str, Any] = {
        "history": recorded.history,
        "vehicles": lambda _: {"vehicles": {}},
        "robots": lambda _: {"robots": {}},
        "streams": lambda _: {"streams": [LOG_STREAM]},
    }
    told: dict[str, Any] = {"subscribe_key": SUBSCRIBE_KEY, "origin": pubnub.origin, "tls": False}
    with PageServer(namespace="iort", answers=answers, track=HALL, **told) as server:
        yield server.url


def rows(page: Page) -> int:
    return int(page.evaluate("iort.robots['car-1'].streams.vesc.kept.rows"))


def test_charts_begin_with_what_was_recorded(
    open_page: Callable[..., Page], served: str, recorded: Recorded, car: Car
) -> None:
    page = open_page(f"{served}#/car/car-1?window=300&charts=battery")
    show(page, car.send())
    until(lambda: rows(page) > 2900, "the last five minutes")
    chart = page.locator("section[aria-label='Battery voltage'] .plot")
    chart.hover()
    until(lambda: "min ago" in page.inner_text("section[aria-label='Battery voltage'] .note"), "a past value")
    assert plain(page.inner_text("[data-reading=voltage_input]")) == "10.00"
    assert recorded.asked_s[0] == pytest.approx(300, abs=1)
    # A longer window asks for the rest only.
    page.select_option("[name=window]", "1800")
    until(lambda: rows(page) > 17_000, "half an hour")
    assert max(recorded.asked_s) == pytest.approx(1500, abs=30)
    # What is kept for the longest window is given back with the car.
    page.keyboard.press("Escape")
    until(lambda: rows(page) < 1000, "the fleet's view to need less")


def test_the_viewers_charts_are_kept_and_shared(
    open_page: Callable[..., Page], page: Page, car: Car, url: str
) -> None:
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
    page.goto(f"{url}#/")
    page.goto(f"{url}#/car/car-1")
    page.reload()
    until(lambda: page.evaluate("window.iort?.link") == "live", "the page to connect")
    show(page, car.send())
    assert page.evaluate(TITLES) == mine
    page.get_by_role("button", name="Reset").click()
    drawn(page)
    assert page.evaluate(TITLES) == first
    assert page.url == f"{url}#/car/car-1"


def test_the_agents_log_lines_are_shown_and_those_of_the_last_hour(
    open_page: Callable[..., Page], served: str, car: Car
) -> None:
    page = open_page(f"{served}#/car/car-1")
    line = {"level": "error", "logger": "iort_agent.sources", "text": "source vesc failed: OSError: gone"}
    show(page, car.send({**line, "left_out": 2}, stream=LOG_STREAM))
    lines = page.get_by_label("Agent's log").locator("li")
    until(lambda: lines.count() == 2, "both lines")
    told = "source vesc failed: OSError: gone 2 lines before were left out"
    assert lines.nth(0).inner_text().splitlines()[1:] == [told]
    assert "connection lost" in lines.nth(1).inner_text()
    # Their texts are no tiles.
    assert page.locator(f"[data-stream={LOG_STREAM}]").count() == 0


def test_the_trajectory_is_drawn_on_the_track(open_page: Callable[..., Page], served: str, car: Car) -> None:
    page = open_page(f"{served}#/car/car-1?charts=trajectory")
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


def test_a_chart_is_dragged_to_another_place(page: Page, car: Car) -> None:
    show(page, car.send(SAMPLE))
    page.get_by_label("Move Speed", exact=True).hover()
    page.mouse.down()
    other = page.locator("section[aria-label='Battery voltage']").bounding_box()
    assert other
    page.mouse.move(other["x"] + other["width"] / 2, other["y"] + other["height"] / 2)
    page.mouse.up()
    assert page.evaluate(TITLES)[:2] == ["Battery voltage", "Speed"]
    assert "charts=battery,speed,currents" in page.url


def test_the_charts_keep_their_height_when_something_opens_beside_them(
    open_page: Callable[..., Page], pubnub: PubNubStandIn
) -> None:
    with Lab().server(pubnub) as server:
        page = open_page(server.invitation("#/car/car-1"))
        show(page, Car(pubnub).send())
        height = "() => document.querySelector('.board .charts').offsetHeight"
        before = page.evaluate(height)
        page.get_by_role("heading", name="Settings").click()
        page.locator(".setting").first.wait_for()
        assert page.evaluate(height) == before


def test_each_latency_says_which_it_is(page: Page, car: Car) -> None:
    show(page, car.send())
    named = ("Delay of the newest message", "Delay of each message", "median of 10 s, car to page")
    assert [page.get_by_text(text, exact=True).count() for text in named] == [1, 1, 1]
