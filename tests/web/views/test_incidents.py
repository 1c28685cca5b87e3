"""What a car's recorder has kept, in a browser: the list, its files, the button, and marks in the past."""

from __future__ import annotations

import base64
import re

import pytest

from testkit.waiting import until
from tests.browser import drawn, show
from tests.images import jpeg
from tests.web.lab import NO_PICTURE, NOW_S, incident


def items(page, view):
    return page.locator(f".{view} .incidents-list li")


def seen(page):
    """Bring a car's list into sight."""
    until(lambda: items(page, "car").count() > 0, "the list")
    items(page, "car").first.evaluate("(node) => node.scrollIntoView()")


def pictured(page):
    """The picture of the first incident, which is made once somebody sees its place."""
    seen(page)
    picture = items(page, "car").first.get_by_role("img")
    until(lambda: picture.count() == 1, "the picture")
    return picture


def test_incidents_are_listed_in_their_newest_state_and_downloaded(open_page, lab, server, car, tmp_path):
    page = open_page(server.url + "#/car/car-1", timezone_id="UTC", accept_downloads=True)
    show(page, car.send())
    listed = items(page, "car")
    until(lambda: listed.count() == 3, "the incidents")
    uploaded, kept, spent = (" ".join(text.split()) for text in listed.all_inner_texts())
    assert "hardbrake uploaded" in uploaded
    assert "12.3 MB, 4321 messages, 3 missing" in uploaded
    assert "take on the car" in kept
    assert "hit the kerb, by operator@lab" in kept
    assert "over budget" in spent
    assert "has spent its 500 MB of the day" in spent
    # Whoever may only look reads and downloads, and keeps nothing.
    assert page.get_by_role("button", name="Keep the last 60 s").count() == 0
    button = page.get_by_role("button", name="Download the incident hardbrake")
    assert button.count() == 1
    with page.expect_download() as loading:
        button.click()
    loading.value.save_as(tmp_path / "file")
    assert loading.value.suggested_filename == "hardbrake-0000000000000001.mcap"
    assert (tmp_path / "file").read_bytes() == b"messages"
    page.get_by_role("button", name="Open the incident hardbrake in Foxglove").click()
    dialog = page.get_by_role("dialog", name="Open in Foxglove")
    assert dialog.locator("code").inner_text() == "iort bridge --incident 0000000000000001"
    dialog.get_by_role("button", name="Close").click()
    lab.refuses = True
    button.click()
    until(lambda: "not in the bucket any more" in listed.first.inner_text(), "the reason")
    listed.first.get_by_role("link").click()
    page.locator(".history .charts canvas").first.wait_for()
    until(lambda: "hardbrake" in items(page, "history").first.inner_text(), "the incident in the past")


def test_an_uploaded_incident_has_a_picture_that_says_what_it_shows(open_page, lab, server, car):
    page = open_page(server.url + "#/car/car-1", timezone_id="UTC")
    show(page, car.send())
    line = pictured(page)
    name = line.get_attribute("aria-label")
    assert re.fullmatch(r"hardbrake, .*[0-9:]{8}.*: current_input from .21 to 3 around the edge", name), name
    assert items(page, "car").get_by_role("img").count() == 1
    # The edge is a line at its time: in the middle of four seconds.
    assert float(line.locator(".edge").get_attribute("x1")) == 80


def test_the_picture_of_a_camera_is_its_image_at_the_edge(open_page, lab, server, car):
    small = jpeg(width=160, height=120)
    about = {**NO_PICTURE, "topic": "/camera/front", "after_s": -0.034}
    lab.shown = {**about, "jpeg": base64.b64encode(small).decode()}
    page = open_page(server.url + "#/car/car-1", timezone_id="UTC")
    show(page, car.send())
    image = pictured(page)
    assert image.get_attribute("aria-label").endswith(": /camera/front, 0.03 s before the edge")
    assert image.evaluate("(canvas) => [canvas.width, canvas.height]") == [160, 120]
    assert page.get_by_text("/camera/front", exact=True).is_visible()


@pytest.mark.parametrize(
    "answer",
    [
        (NO_PICTURE, False),
        # What is no small JPEG is not decoded.
        ({**NO_PICTURE, "jpeg": base64.b64encode(jpeg(width=300, height=20)).decode()}, False),
        (NO_PICTURE, True),
    ],
)
def test_what_has_no_picture_leaves_the_list_as_it_is(open_page, lab, server, car, answer):
    lab.shown, lab.refuses = answer
    page = open_page(server.url + "#/car/car-1")
    show(page, car.send())
    seen(page)
    until(lambda: lab.pictures, "the question")
    until(lambda: items(page, "car").locator(".incident-picture").count() == 0, "no picture")
    assert items(page, "car").count() == 3


def test_only_the_pictures_that_are_seen_are_asked_for_one_after_another(open_page, lab, server, car):
    lab.incidents = [incident(i, "uploaded", bytes=5, messages=1) for i in range(60)]
    page = open_page(server.url + "#/car/car-1")
    show(page, car.send())
    pictured(page)
    assert f"{59:016x}" not in lab.pictures
    items(page, "car").last.evaluate("(node) => node.scrollIntoView()")
    until(lambda: items(page, "car").last.get_by_role("img").count() == 1, "the last picture")
    assert len(lab.pictures) == len(set(lab.pictures)) < 60


def test_the_stream_of_incidents_is_no_stream_of_tiles_and_long_words_break(open_page, lab, server, car):
    lab.incidents[0]["why"] = "speed_mps=" + "4" * 60
    page = open_page(server.url + "#/car/car-1")
    car.send({"x_m": 1.0}, stream="pose")
    car.send({"id": "0a", "state": "kept"}, stream="incidents")
    show(page, car.send())
    until(lambda: page.locator("section.stream").count() == 2, "the streams")
    assert page.locator("section.stream[data-stream=incidents]").count() == 0
    seen(page)
    cut = "(node) => node.scrollWidth > node.clientWidth"
    assert not page.locator(".car .incidents-list").evaluate(cut)


def test_the_button_shows_the_cars_answer(open_page, lab, server, car):
    page = open_page(server.invitation("#/car/car-1"))
    show(page, car.send())
    said, button = page.locator(".incidents .said"), page.get_by_role("button", name="Keep the last 60 s")
    lab.keeps = {"accepted": False, "reason": "no recorder: car.yaml has no section recorder", "online": True}
    button.click()
    until(lambda: said.inner_text() == f"car-1 refuses: {lab.keeps['reason']}", "the refusal")
    lab.keeps = {"accepted": None, "reason": "", "online": False}
    button.click()
    until(lambda: "it keeps them when it is back" in said.inner_text(), "the car to be away")
    lab.keeps["online"] = True
    button.click()
    until(lambda: "No answer" in said.inner_text(), "no answer")
    lab.keeps = {"accepted": True, "reason": "", "online": True}
    button.click()
    until(lambda: said.inner_text() == "car-1 keeps them, and uploads them.", "the answer")
    assert lab.asked == [{"robot": "car-1", "last_s": "60"}] * 4
    # It is in the list without a reload, and so is its upload.
    until(lambda: items(page, "car").count() == 4, "what is kept")
    lab.incidents[0] |= {"state": "uploaded", "bytes": 5_000}
    until(lambda: "5.0 kB" in items(page, "car").first.inner_text(), "the upload")


def test_a_note_may_have_the_car_keep_what_was_before_it(open_page, lab, server, car):
    page = open_page(server.invitation("#/car/car-1"))
    show(page, car.send())
    page.fill("[name=note]", "lost the rear")
    page.get_by_label("Keep 60 s").check()
    page.get_by_role("button", name="Add note").click()
    until(lambda: "is to keep the 60 s before it" in page.inner_text(".notes:not(.incidents) .said"), "it")
    assert lab.asked == [{"robot": "car-1", "text": "lost the rear", "keep_s": "60"}]
    assert not page.get_by_label("Keep 60 s").is_checked()


def test_the_past_has_marks_where_incidents_are(open_page, lab, server):
    lab.incidents, incidents = [], lab.incidents
    page = open_page(server.invitation("#/history/car-1"))
    chart = page.locator("section[aria-label='Battery voltage'] canvas").first
    chart.wait_for()
    drawn(page)
    before = chart.screenshot()
    assert not page.locator(".history .incidents").is_visible()
    lab.incidents = incidents
    page.reload()
    until(lambda: items(page, "history").count() == 3, "the incidents")
    assert page.locator(".incidents .mark").all_inner_texts() == ["C", "B", "A"]
    drawn(page)
    assert chart.screenshot() != before
    # Those of the range alone.
    at_us = round(NOW_S - 7200) * 1_000_000
    lab.incidents = [{**incidents[0], "from_us": at_us, "to_us": at_us + 1}]
    page.reload()
    until(lambda: not page.locator(".history .incidents").is_visible(), "another range")


def test_the_fleet_says_how_many_incidents_the_last_day_had(open_page, server, car):
    page = open_page(server.url)
    show(page, car.send())
    badge = page.locator("[data-robot=car-1] .incidents-badge")
    until(lambda: badge.inner_text() == "3 incidents", "the number")
    page.get_by_text("Not heard: 1 car").click()
    assert page.locator("[data-absent=car-9] .incidents-badge").inner_text() == "1 incident"
