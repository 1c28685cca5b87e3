"""Every number has a unit and every time a time zone, in the live view and in the history."""

from __future__ import annotations

import re
from itertools import product

from iort_contract.catalog.streams import LOG_STREAM
from iort_contract.catalog.vesc import VESC_STREAM
from local.deployment import ROOT
from testkit.waiting import until
from tests.browser import plain, show, shown
from tests.web.cars import GAIN, SAMPLE, Car
from tests.web.lab import VIEWS, past

OFFSET_ERPM = 461.4
VEHICLE = {"speed_to_erpm_gain": GAIN, "speed_to_erpm_offset": OFFSET_ERPM}
SPEED_ERPM = (9228.0 + OFFSET_ERPM, 4614.0 + OFFSET_ERPM)
ANSWERS = {
    "streams": lambda _: {"streams": [VESC_STREAM]},
    "history": lambda asked: past(
        [int(asked["from_us"]) / 1e6 + second for second in (0, 1)],
        {"speed": SPEED_ERPM, "voltage_input": [12.0, 11.5]},
    ),
}


def test_the_speed_uses_the_cars_gain_and_offset(open_page, serve, car):
    server = serve(vehicles={"car-1": VEHICLE}, answers=ANSWERS)
    page = open_page(f"{server.url}#/car/car-1")
    show(page, car.send({**SAMPLE, "speed": SPEED_ERPM[0]}))
    assert shown(page, "speed_mps") == "2.00"
    assert plain(page.locator("[data-reading=speed]").inner_text()) == "2.00"
    # The history shows the same.
    page.goto(f"{server.url}#/history/car-1")
    row = page.locator("tr[data-field=speed]")
    told = ["1.00", "2.00", "+1.00", "m/s"]
    until(lambda: [plain(text) for text in row.locator("td").all_inner_texts()] == told, "then and now")
    page.locator(".scrub").focus()
    page.keyboard.press("Home")
    until(lambda: plain(row.locator("td").first.inner_text()) == "2.00", "the first sample")
    panel = page.locator("section.panel[aria-label=Speed]")
    assert panel.locator(".unit").inner_text() == "m/s"


def test_an_unknown_car_shows_its_motor_speed(open_page, serve, car):
    server = serve(answers=ANSWERS)
    page = open_page(f"{server.url}#/history/car-1")
    row = page.locator("tr[data-field=speed]")
    until(lambda: "erpm" in row.inner_text(), "the past")
    assert plain(row.locator("td").first.inner_text()) == f"{SPEED_ERPM[1]:.0f}"
    page.goto(f"{server.url}#/car/car-1")
    show(page, car.send())
    assert page.locator(".gauge", has_text="Speed").locator(".gauge-value .unit").inner_text() == "erpm"


def test_every_view_tells_the_zone_of_its_times(open_page, server, car):
    page = open_page(server.invitation(), timezone_id="Asia/Kolkata", locale="de-DE")
    line = {"level": "error", "logger": "iort_agent", "text": "failed", "left_out": 0}
    for view, (address, filled) in VIEWS.items():
        page.goto(server.url + address)
        show(page, car.send())
        show(page, car.send(line, stream=LOG_STREAM))
        page.locator(filled).first.wait_for()
        if view == "car":
            assert page.locator(".faults th").first.inner_text() == "Since, GMT+5:30"
        if view == "history":
            assert page.locator(".zone").inner_text() == "GMT+5:30"
        if view == "panels of the past":
            # The head of the column of times says it, once.
            assert page.locator(".rows th").first.inner_text().startswith("Time, GMT+5:30")
        # In one step: the table writes its rows again.
        told = page.evaluate(
            """() => {
              document.querySelector(".rows tbody")?.replaceChildren();
              return document.body.textContent;
            }"""
        )
        assert re.findall(r"\d\d:\d\d:\d\d(?!.{0,24}GMT\+5:30)", told) == [], view


def test_ros_standard_messages_have_their_units(page, car):
    sample = {"linear_acceleration.x": 1.5, "twist.twist.angular.z": -0.25, "position.y": 2, "position.w": 3}
    show(page, car.send(sample, stream="odom"))
    tiles = page.locator("[data-stream=odom] .tile-value").all_inner_texts()
    assert [plain(text).replace("\n", " ") for text in tiles] == ["1.50m/s²", "-0.25rad/s", "2.00m", "3"]


def test_the_page_counts_faulty_cars(page, car):
    cars = [Car(car.pubnub, name) for name in ("a", "b", "c")]

    def counted(*codes):
        # One that is gone does not count: on a busy machine all send again.
        sent = [each.send({**SAMPLE, "fault_code": code}) for each, code in zip(cars, codes, strict=True)]
        for update in sent:
            show(page, update)
        return page.inner_text("#faulty")

    for codes, words in (((5, 0, 3), "2 with a fault"), ((0, 0, 3), "1 with a fault"), ((0, 0, 0), "")):
        until(lambda codes=codes, words=words: counted(*codes) == words, words or "no fault")


def luminance(colour):
    """Relative luminance, WCAG 2.2."""
    parts = [int(colour[i : i + 2], 16) / 255 for i in (1, 3, 5)]
    red, green, blue = (p / 12.92 if p <= 0.04045 else ((p + 0.055) / 1.055) ** 2.4 for p in parts)
    return 0.2126 * red + 0.7152 * green + 0.0722 * blue


def contrast(one, other):
    low, high = sorted((luminance(one), luminance(other)))
    return (high + 0.05) / (low + 0.05)


def test_text_and_lines_have_enough_contrast_in_both_themes():
    style = (ROOT / "station" / "web" / "style" / "theme.css").read_text()
    pairs = re.findall(r"--([a-z0-9-]+): light-dark\((#\w{6}), (#\w{6})\)", style)
    colours = {name: (light, dark) for name, light, dark in pairs}
    lines = {"speed", "voltage", "motor", "battery", "duty", "delay", *(f"hue-{i}" for i in range(1, 7))}
    ramp = [f"ramp-{i}" for i in range(1, 6)]
    lines |= {*ramp}
    # The colours of a way grow lighter from low to high, for those who do not see colours.
    for theme in (0, 1):
        steps = [luminance(colours[name][theme]) for name in ramp]
        assert steps == sorted(steps)
    assert lines < colours.keys()
    # WCAG level AA: 4.5 for text, 3 for graphics.
    wanted = dict.fromkeys(lines, 3.0) | dict.fromkeys(("text", "muted", "good", "warn", "bad"), 4.5)
    for theme, ground in product((0, 1), ("page", "panel")):
        for name, least in wanted.items():
            found = contrast(colours[name][theme], colours[ground][theme])
            assert found >= least, f"{name} on {ground}, {('light', 'dark')[theme]}: {found:.2f}"
    for theme in (0, 1):
        assert contrast("#ffffff", colours["bad-fill"][theme]) >= 4.5
