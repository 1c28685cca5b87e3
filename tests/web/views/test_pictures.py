"""A camera's thumbnails on the page: it draws the sent pictures and ignores invalid ones."""

from __future__ import annotations

import base64
import io
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import pytest

from iort_agent.lanes.attachment import thumbnail
from iort_station.page.server import PageServer
from testkit.waiting import until
from tests.browser import drawn, show
from tests.images import jpeg
from tests.web.cars import SAMPLE, SUBSCRIBE_KEY, Car

if TYPE_CHECKING:
    from playwright.sync_api import Page

    from local.pubnub.standin import PubNubStandIn

KEY = "robots/car-1/2026/05/04/100000-0123456789abcdef/camera/1-data.jpg"
STREAM = "camera"


def with_attachment(picture: str | None, **change: Any) -> dict[str, Any]:
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


def plain_jpeg(colour: tuple[int, int, int], size: tuple[int, int] = (96, 54)) -> str:
    Image = pytest.importorskip("PIL.Image", reason="Pillow is not installed")  # noqa: N806 - a module
    out = io.BytesIO()
    Image.new("RGB", size, colour).save(out, "JPEG", quality=90)
    return base64.b64encode(out.getvalue()).decode()


def middle(page: Page) -> list[int]:
    """Return red, green and blue in the middle of the picture."""
    script = """() => {
      const canvas = document.querySelector("[data-picture=data] canvas");
      const pixel = canvas.getContext("2d").getImageData(canvas.width / 2, canvas.height / 2, 1, 1);
      return [...pixel.data].slice(0, 3);
    }"""
    return list(page.evaluate(script))


def is_drawn(page: Page, colour: tuple[int, int, int]) -> None:
    def near() -> bool:
        return all(abs(a - b) < 12 for a, b in zip(middle(page), colour, strict=True))

    until(near, f"a picture of {colour}")


def test_a_cameras_thumbnail_is_drawn_and_stays_while_others_are_left_out(page: Page, car: Car) -> None:
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


def test_the_page_draws_the_agents_thumbnails(page: Page, car: Car) -> None:
    made = thumbnail(jpeg(1), "image/jpeg")
    assert made is not None
    show(page, car.send(with_attachment(made), stream=STREAM))
    canvas = page.locator("[data-picture=data] canvas")
    until(canvas.is_visible, "the picture")
    assert page.evaluate("(c) => [c.width, c.height]", canvas.element_handle()) == [96, 72]


def hostile_texts() -> dict[str, str]:
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


def test_an_invalid_picture_is_reported(page: Page, car: Car) -> None:
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


def test_a_field_named_like_an_attachment_is_shown_unchanged(page: Page, car: Car) -> None:
    show(page, car.send({**SAMPLE, "data.thumbnail": "text", "data.key": "k"}))
    assert page.locator("[data-picture]").count() == 0
    assert page.locator("[data-value='data.thumbnail']").inner_text() == "text"


def test_the_history_shows_the_picture_of_the_selected_time(
    open_page: Callable[..., Page], pubnub: PubNubStandIn
) -> None:
    red, green = plain_jpeg((200, 30, 30)), plain_jpeg((20, 160, 40))
    rows = [with_attachment(red), LEFT_OUT, LEFT_OUT, with_attachment(green), LEFT_OUT]
    fields = {name: {"mean": [row[name] for row in rows]} for name in rows[0]}

    def history(asked: Any) -> dict[str, Any]:
        first = int(asked["from_us"]) / 1e6
        times = [first + 0.5 * i for i in range(len(rows))]
        return {
            "times_s": times,
            "fields": fields,
            "samples": len(rows),
            "ros2": False,
            "archive": None,
            "row_s": 0,
        }

    answers = {"streams": lambda _: {"streams": [STREAM]}, "history": history}
    told = {"namespace": "iort", "subscribe_key": SUBSCRIBE_KEY, "origin": pubnub.origin, "tls": False}
    with PageServer(**told, answers=answers) as server:
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
