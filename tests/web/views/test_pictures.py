"""What every view looks like: pictures, and accessibility in both themes."""

from __future__ import annotations

import base64
import io
from pathlib import Path

import pytest

from iort_agent.lanes.attachment import thumbnail
from iort_contract.catalog.streams import LOG_STREAM
from testkit.waiting import until
from tests.browser import drawn, plain, show
from tests.images import jpeg
from tests.web.cars import SAMPLE, Car
from tests.web.lab import VIEWS, past

KEY = "robots/car-1/2026/05/04/100000-0123456789abcdef/camera/1-data.jpg"
STREAM = "camera"


def with_attachment(picture, **change):
    """Make a sample with an attachment on its field ``data``."""
    claim = {
        "key": KEY,
        "sha256": "0" * 64,
        "size": 123_456,
        "content_type": "image/jpeg",
        "thumbnail": picture,
    }
    return {"format": "jpeg", **{f"data.{name}": value for name, value in {**claim, **change}.items()}}


LEFT_OUT = with_attachment(None, key=None, sha256=None, size=None, content_type=None)


def plain_jpeg(colour, size=(96, 54)):
    Image = pytest.importorskip("PIL.Image", reason="Pillow is not installed")  # noqa: N806 - a module
    out = io.BytesIO()
    Image.new("RGB", size, colour).save(out, "JPEG", quality=90)
    return base64.b64encode(out.getvalue()).decode()


def middle(page):
    """Return red, green and blue in the middle of the picture."""
    script = """() => {
      const canvas = document.querySelector("[data-picture=data] canvas");
      const pixel = canvas.getContext("2d").getImageData(canvas.width / 2, canvas.height / 2, 1, 1);
      return [...pixel.data].slice(0, 3);
    }"""
    return list(page.evaluate(script))


def is_drawn(page, colour):
    def near():
        return all(abs(a - b) < 12 for a, b in zip(middle(page), colour, strict=True))

    until(near, f"a picture of {colour}")


def test_a_cameras_thumbnail_is_drawn_and_stays_while_others_are_left_out(page, car):
    show(page, car.send(LEFT_OUT, stream=STREAM))
    tile = page.locator("[data-picture=data]")
    assert "no picture yet" in tile.inner_text()
    show(page, car.send(with_attachment(plain_jpeg((200, 30, 30))), stream=STREAM))
    is_drawn(page, (200, 30, 30))
    for _ in range(3):
        show(page, car.send(LEFT_OUT, stream=STREAM))
    is_drawn(page, (200, 30, 30))
    until(lambda: "s old" in tile.inner_text(), "its age")
    assert "image/jpeg, 123.5 kB" in tile.inner_text()
    assert tile.get_attribute("title") == f"iort files get: {KEY}"
    assert tile.locator("canvas").get_attribute("aria-label") == "Data, 96 by 54 pixels"
    # Its five fields get no text tiles; the other fields do.
    labels = page.locator(f"[data-stream={STREAM}] .tile-label").all_inner_texts()
    assert labels == ["Data", "Format"]
    show(page, car.send(with_attachment(plain_jpeg((20, 160, 40))), stream=STREAM))
    is_drawn(page, (20, 160, 40))


def test_the_page_draws_the_agents_thumbnails(page, car):
    made = thumbnail(jpeg(1), "image/jpeg")
    assert made is not None
    show(page, car.send(with_attachment(made), stream=STREAM))
    canvas = page.locator("[data-picture=data] canvas")
    until(canvas.is_visible, "the picture")
    assert page.evaluate("(c) => [c.width, c.height]", canvas.element_handle()) == [96, 72]


def hostile_texts():
    """Return texts that are not our thumbnails; the last two declare a size above the limit."""
    small = bytearray(base64.b64decode(plain_jpeg((0, 0, 0))))
    at = small.index(b"\xff\xc0")
    small[at + 5 : at + 9] = (65_500).to_bytes(2, "big") * 2
    # A complete picture behind a marker without length (TEM): a parser that expects a length reads the next
    # one.
    whole = base64.b64decode(plain_jpeg((0, 200, 0), (300, 300)))[2:]
    little = base64.b64decode(plain_jpeg((0, 0, 0)))[2:]
    hidden = b"\xff\xd8\xff\x01" + (2 + len(whole)).to_bytes(2, "big") + whole + little
    return {
        "no base64": "<img src=x onerror=alert(1)>",
        "nothing": "",
        "no JPEG": base64.b64encode(b"GIF89a" + bytes(50)).decode(),
        "a JPEG cut short": plain_jpeg((0, 0, 0))[:40],
        "a JPEG without end": base64.b64encode(b"\xff\xd8" + b"\xff\xe0\x00\x00" * 10).decode(),
        "a bomb": base64.b64encode(bytes(small)).decode(),
        "a bomb behind a curtain": base64.b64encode(hidden).decode(),
    }


def test_an_invalid_picture_is_reported(page, car):
    tile = page.locator("[data-picture=data]")
    for what, text in hostile_texts().items():
        show(page, car.send(with_attachment(plain_jpeg((10, 10, 200))), stream=STREAM))
        until(tile.locator("canvas").is_visible, "a good one")
        show(page, car.send(with_attachment(text), stream=STREAM))
        until(lambda: "is no picture" in tile.inner_text(), what)
        assert not tile.locator("canvas").is_visible()
    show(page, car.send(with_attachment(None), stream=STREAM))
    until(lambda: "makes no thumbnails" in tile.inner_text(), "the reason")
    show(page, car.send(with_attachment(None, content_type="application/octet-stream"), stream=STREAM))
    until(lambda: "no picture" in tile.inner_text(), "the notice of an invalid picture")


def test_a_field_named_like_an_attachment_is_shown_unchanged(page, car):
    show(page, car.send({**SAMPLE, "data.thumbnail": "text", "data.key": "k"}))
    assert page.locator("[data-picture]").count() == 0
    assert page.locator("[data-value='data.thumbnail']").inner_text() == "text"


def test_the_history_shows_the_picture_of_the_selected_time(open_page, serve):
    red, green = plain_jpeg((200, 30, 30)), plain_jpeg((20, 160, 40))
    rows = [with_attachment(red), LEFT_OUT, LEFT_OUT, with_attachment(green), LEFT_OUT]
    fields = {name: [row[name] for row in rows] for name in rows[0]}

    def history(asked):
        return past([int(asked["from_us"]) / 1e6 + 0.5 * i for i in range(len(rows))], fields)

    server = serve(answers={"streams": lambda _: {"streams": [STREAM]}, "history": history})
    page = open_page(f"{server.url}#/history/car-1")
    tile = page.locator("[data-picture=data]")
    until(lambda: tile.count() == 1 and tile.locator("canvas").is_visible(), "the last picture")
    is_drawn(page, (20, 160, 40))
    assert "0.5 s before" in tile.inner_text()
    page.locator(".scrub").focus()
    page.keyboard.press("Home")
    is_drawn(page, (200, 30, 30))
    page.keyboard.press("ArrowRight")
    drawn(page)
    assert "0.5 s before" in tile.inner_text()
    is_drawn(page, (200, 30, 30))
    # The table of values leaves out the attachment's five fields.
    assert page.locator(".compare tbody th").all_inner_texts() == ["Format"]


AXE = Path(__file__).parents[3] / "node_modules" / "axe-core" / "axe.min.js"
DESKTOP = {"viewport": {"width": 1280, "height": 900}}
PHONE = {"viewport": {"width": 390, "height": 844}, "has_touch": True, "is_mobile": True}
FAULTY = {**SAMPLE, "fault_code": 2}
LOGGED = {
    "level": "error",
    "logger": "iort_agent",
    "text": "failed\nwith details",
    "left_out": 1,
}
RULES = ["wcag2a", "wcag2aa", "wcag21a", "wcag21aa", "wcag22aa", "best-practice"]
# What a finger can hit, in CSS pixels; links within a text are as high as the text.
TARGET_PX = 44
SMALL = """(least) => [...document.querySelectorAll("a, button, input, select, summary, [tabindex='0']")]
  .filter((node) => node.checkVisibility() && getComputedStyle(node).display !== "inline")
  .map((node) => [node, (node.closest("label:has([type=checkbox])") ?? node).getBoundingClientRect()])
  .filter(([_, { width, height }]) => width < least - 0.5 || height < least - 0.5)
  .map(([node, { width, height }]) => `${width} x ${height}: ${node.outerHTML.slice(0, 90)}`)"""

BEYOND = "document.documentElement.scrollWidth - document.documentElement.clientWidth"


def violations(page):
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


def silent(page, car, state):
    """Whether a car that has sent is stale or gone; on a slow machine a car that is gone sends again."""
    if state == "stale" and page.locator("[data-state=gone]").count():
        show(page, car.send(FAULTY))
    return page.locator(f"[data-state={state}]").count()


@pytest.mark.parametrize(("device", "theme"), [(DESKTOP, "dark"), (PHONE, "light")], ids=["desktop", "phone"])
def test_every_view_is_accessible(open_page, server, car, device, theme):
    faults = {}
    page = open_page(server.invitation(), color_scheme=theme, reduced_motion="reduce", **device)
    page.evaluate(AXE.read_text())
    for view, (address, filled) in VIEWS.items():
        page.goto(server.url + address)
        show(page, car.send(FAULTY))
        page.locator(filled).first.wait_for()
        if view == "car":
            show(page, car.send(LOGGED, stream=LOG_STREAM))
            page.get_by_role("heading", name="Settings").click()
            page.locator(".setting").first.wait_for()
            page.get_by_role("button", name="Take the wheel").click()
            page.get_by_text("The role of a driver cannot be assumed").wait_for()
        if view == "panels of the past":
            page.locator("section[aria-label='Battery voltage'] [aria-label=Alarm]").click()
            page.locator(".threshold").wait_for()
        faults[view] = violations(page)
        if device is PHONE:
            faults[f"{view}, by thumb"] = page.evaluate(SMALL, TARGET_PX)
            faults[f"{view}, sideways"] = page.evaluate(BEYOND)
    if device is DESKTOP:
        # Old values are readable, too.
        page.goto(server.url + VIEWS["car"].address)
        show(page, car.send(FAULTY))
        for view, state in (("car", "stale"), ("fleet", "gone"), ("car", "gone")):
            page.goto(server.url + VIEWS[view].address)
            until(lambda state=state: silent(page, car, state), f"{view} to be {state}")
            faults[f"{view}, {state}"] = violations(page)
    assert {view: found for view, found in faults.items() if found} == {}


def test_a_card_outside_the_screen_has_a_name(page, car, url):
    page.goto(f"{url}#/")
    names = [f"car-{i}" for i in range(40)]
    for name in names:
        Car(car.pubnub, name).send()
    until(lambda: page.locator(".card").count() == len(names), "the cards")
    nodes = page.context.new_cdp_session(page).send("Accessibility.getFullAXTree")["nodes"]
    links = [node["name"]["value"] for node in nodes if node.get("role", {}).get("value") == "link"]
    assert [name for name in names if not any(name in link for link in links)] == []
    assert "" not in links


def test_a_chart_is_told_in_words_and_has_a_cursor_for_arrow_keys(open_page, url, car):
    page = open_page(f"{url}#/car/car-1?window=300")
    for volts in (11.0, 12.5, 11.75):
        show(page, car.send({**SAMPLE, "voltage_input": volts}))
    chart = page.locator("[role=img][aria-label^='Chart Battery voltage']")
    figures = "newest 11.75 V, minimum 11.00 V, maximum 12.50 V"
    until(lambda: figures in (chart.get_attribute("aria-label") or ""), "the figures")
    spoken, reading = page.locator("#spoken"), page.locator("[data-reading=voltage_input]")
    chart.focus()
    page.keyboard.press("ArrowLeft")
    until(lambda: spoken.inner_text().endswith(" s ago: 11.75 V"), "the newest value")

    def at(keys, volts):
        # The chart moves on below a cursor that stays.
        for key in keys.split():
            page.keyboard.press(key)
        return spoken.inner_text().endswith(f" s ago: {volts} V") and reading.inner_text() == volts

    for keys, volts in (("End ArrowLeft", "12.50"), ("Home", "11.00"), ("End", "11.75")):
        until(lambda keys=keys, volts=volts: at(keys, volts), f"{volts} V, spoken and as a figure")
    # The keys moved the cursor, and not to another car.
    page.keyboard.press("Escape")
    until(lambda: spoken.inner_text() == "", "the cursor to be gone")
    assert page.url.endswith("#/car/car-1?window=300")


def test_a_chart_of_the_past_is_told_in_words_and_has_a_cursor_for_arrow_keys(open_page, server):
    page = open_page(server.url + VIEWS["history"].address)
    chart = page.locator("[role=img][aria-label^='Chart Battery voltage']")
    extent = f"minimum -{SAMPLE['voltage_input']} V, maximum {SAMPLE['voltage_input']} V"
    until(lambda: extent in plain(chart.get_attribute("aria-label") or ""), "the figures")
    chart.focus()
    page.keyboard.press("Home")
    until(lambda: page.inner_text("#spoken").endswith(": 0.00 V"), "the first value")
    page.keyboard.press("ArrowRight")
    until(lambda: page.inner_text("#spoken").endswith(": 1.29 V"), "the second value")
    until(lambda: page.inner_text("[data-reading=voltage_input]") == "1.29", "its reading")
