"""The picture of a car's camera in a browser: by WebRTC or over the broker, its age, and driving by it."""

from __future__ import annotations

import pytest

pytest.importorskip("aiortc", reason="aiortc is not installed")

import re
from dataclasses import asdict

from iort_contract.counter import read_counter
from testkit.waiting import until
from tests.browser import drawn, show
from tests.web.broker import PageBroker
from tests.web.camera import TERMS, CameraCar, refusing, unreachable
from tests.web.test_links import HIDE
from tests.web.views.test_control import Fingers, held, middle
from tests.web.views.test_pictures import AXE, BEYOND, DESKTOP, PHONE, SMALL, TARGET_PX, violations


@pytest.fixture
def broker():
    with PageBroker() as broker:
        yield broker


@pytest.fixture
def lab(lab, broker):
    lab.video, lab.broker = asdict(TERMS), broker
    return lab


@pytest.fixture
def camera(broker):
    with CameraCar(broker) as camera:
        yield camera


def sight(page, **wanted):
    """Wait until the picture's state, way and so on are these."""
    selector = "".join(f"[data-{name}={value}]" for name, value in wanted.items())
    page.locator(f".sight{selector}").wait_for()


def phase(page, wanted):
    page.locator(f".drive[data-phase={wanted}]").wait_for()


# The picture's number as the page tells it, and the brightness of the pixels that are on the screen.
SCREEN = """() => {
  const panel = document.querySelector(".sight");
  const shown = panel.querySelector(panel.dataset.way === "webrtc" ? "video" : "canvas");
  const canvas = document.createElement("canvas");
  [canvas.width, canvas.height] = [shown.videoWidth ?? shown.width, shown.videoHeight ?? shown.height];
  canvas.getContext("2d").drawImage(shown, 0, 0);
  const { data } = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height);
  const luma = Array.from({ length: data.length / 4 }, (_, i) => data[4 * i + 1]);
  return [Number(panel.dataset.frame), luma, canvas.width, canvas.height];
}"""


def is_told_truly(page):
    """Wait until the number that the page tells is that in the picture on the screen."""

    def same():
        number, luma, width, height = page.evaluate(SCREEN)
        return number == read_counter(lambda x, y: luma[y * width + x], width, height)

    until(same, "the number of the picture on the screen")


# The colour of the edge that is drawn over the picture.
EDGE = """() => getComputedStyle(document.querySelector(".sight-frame"), "::after").borderTopColor"""


def open_car(open_page, address, car, **options):
    page = open_page(address, **options)
    show(page, car.send())
    return page


def look(page):
    page.get_by_role("button", name="Look", exact=True).click()


def take_the_wheel(page):
    page.get_by_role("button", name="Take the wheel").click()
    sight(page, state="live")


def hold(page, press, release, works, what):
    """Hold the dead-man's switch until it works. On a busy machine an answer may come too late, which ends a
    hold: then it is let go, and held again."""
    press()

    def tried():
        if page.get_attribute(".drive", "data-phase") == "over":
            release()
            press()
        return works()

    until(tried, what)


def drive(page, works=lambda: True):
    """Hold it by a key until the car takes commands."""
    hold(
        page,
        lambda: page.keyboard.down("Space"),
        lambda: page.keyboard.up("Space"),
        lambda: page.get_attribute(".drive", "data-phase") == "driving" and works(),
        "the car to be driven",
    )


def motions(camera):
    """The commands that may move the car."""
    return [command for command in list(camera.commands) if not command.get("ends")]


def moves(camera):
    return any(command["message"]["drive"]["speed"] > 0 for command in motions(camera)[-1:])


def looked_at(camera, by_webrtc, over_broker):
    """Wait until so many look: on a busy machine small pictures may come first, and end a moment later."""
    until(lambda: camera.viewers == (by_webrtc, over_broker), "those who look")


def offers(broker):
    return [look["kind"] for look in broker.sent("/video")].count("offer")


def test_the_picture_is_shown_with_its_age_and_only_while_somebody_looks(
    open_page, server, car, broker, camera
):
    # Everybody who can open the page may look.
    page = open_car(open_page, f"{server.url}#/car/car-1", car)
    assert page.locator(".sight-frame").is_hidden()
    assert broker.taken == []
    look(page)
    sight(page, state="live", way="webrtc")
    is_told_truly(page)
    assert page.inner_text(".sight-age").endswith(" ms")
    line = page.locator(".sight-line")
    figures = rf"WebRTC: {TERMS.width} \u00d7 {TERMS.height}, .*pictures/s"
    until(lambda: re.match(figures, line.inner_text()), "the figures")
    looked_at(camera, 1, 0)
    page.get_by_role("button", name="Stop looking").click()
    looked_at(camera, 0, 0)
    assert page.locator(".sight-frame").is_hidden()
    # Another view ends it, too.
    look(page)
    sight(page, state="live")
    page.goto(f"{server.url}#/alarms")
    looked_at(camera, 0, 0)


def test_a_car_without_a_camera_has_no_panel(open_page, lab, server, car):
    lab.video = None
    page = open_car(open_page, f"{server.url}#/car/car-1", car)
    page.get_by_role("heading", name="Fault log").wait_for()
    assert page.locator(".sight").is_hidden()


def test_driving_ends_when_the_picture_freezes_and_begins_with_a_new_hold(open_page, server, car, camera):
    page = open_car(open_page, server.invitation("#/car/car-1"), car)
    # The wheel has the picture by itself.
    take_the_wheel(page)
    # The pictures of another way may be older.
    sight(page, state="live", way="webrtc")
    assert not page.locator("[name=blind]").last.is_checked()
    page.keyboard.down("ArrowUp")
    drive(page, lambda: moves(camera))
    # Every command names a picture that was on the screen.
    frames = [command["frame"] for command in motions(camera)]
    assert frames == sorted(frames)
    assert frames[0] > 0
    assert all("blind" not in command for command in camera.commands)
    camera.sees.clear()
    sight(page, state="frozen")
    assert page.evaluate(EDGE) == "rgb(179, 38, 30)"
    phase(page, "over")
    words = page.locator(".sight-words")
    until(lambda: words.inner_text().startswith("Frozen for "), "the words")
    assert words.inner_text().endswith(" s: driving has ended")
    assert page.locator(".sight [role=status]").inner_text() == "The picture is frozen"
    until(lambda: camera.commands[-1].get("ends"), "the lease to be given up")
    sent, told = len(motions(camera)), words.inner_text()
    until(lambda: words.inner_text() != told, "time to pass")
    camera.sees.set()
    sight(page, state="live")
    # What has come back moves nothing by itself.
    assert page.get_attribute(".drive", "data-phase") == "over"
    assert len(motions(camera)) == sent
    page.keyboard.up("Space")
    drive(page)
    assert len(motions(camera)) > sent


def test_a_late_picture_ends_driving_though_it_moves(open_page, server, car, camera):
    page = open_car(open_page, server.invitation("#/car/car-1"), car)
    take_the_wheel(page)
    drive(page)
    camera.late_us = 20_000_000
    sight(page, state="late")
    assert page.evaluate(EDGE) == "rgb(255, 196, 0)"
    phase(page, "over")
    late = rf"Late, 2\d\D?\d\d\d ms old, at most {TERMS.max_age_ms} ms: driving has ended"
    assert re.fullmatch(late, page.inner_text(".sight-words"))


def test_a_hidden_tab_shows_nothing_and_drives_nothing(open_page, server, car, camera):
    page = open_car(open_page, server.invitation("#/car/car-1"), car)
    take_the_wheel(page)
    drive(page)
    page.evaluate(HIDE, True)
    looked_at(camera, 0, 0)
    until(lambda: camera.commands[-1].get("ends"), "the lease to be given up")
    sent = len(motions(camera))
    page.evaluate(HIDE, False)
    sight(page, state="live")
    assert page.get_attribute(".drive", "data-phase") != "driving"
    assert len(motions(camera)) == sent


@pytest.mark.parametrize("change", [refusing, unreachable])
def test_without_webrtc_small_pictures_come_over_the_broker_and_it_is_tried_again(
    open_page, server, car, camera, change
):
    camera.change = change
    page = open_car(open_page, server.invitation("#/car/car-1"), car)
    take_the_wheel(page)
    sight(page, state="live", way="broker")
    is_told_truly(page)
    line = page.locator(".sight-line")
    until(lambda: line.inner_text().startswith("Small pictures over the broker (WebRTC: "), "why")
    drive(page)
    number = int(page.get_attribute(".sight", "data-frame") or 0)
    until(lambda: motions(camera)[-1]["frame"] > number, "commands to name newer pictures")
    camera.sees.clear()
    sight(page, state="frozen")
    phase(page, "over")
    page.keyboard.up("Space")
    camera.sees.set()
    camera.change = lambda show: show
    sight(page, state="live", way="webrtc")
    looked_at(camera, 1, 0)


def test_who_drives_blind_says_so_with_every_command_and_never_by_a_choice_that_is_kept(
    open_page, server, car, camera
):
    page = open_car(open_page, server.invitation("#/car/car-1"), car)
    take_the_wheel(page)
    box = page.get_by_label("Drive blind")
    box.check()
    camera.sees.clear()
    sight(page, state="frozen")
    # The key drives, though the box was pressed last.
    drive(page)
    assert box.is_checked()
    sent = len(camera.commands)
    until(lambda: len(camera.commands) > sent, "commands without a live picture")
    assert all(command["blind"] for command in camera.commands)
    assert page.inner_text(".sight-words").endswith(": you drive blind")
    # A press on the box is no hold, and the car is given up without a picture.
    box.uncheck()
    until(lambda: camera.commands[-1].get("ends"), "the lease to be given up")
    page.keyboard.up("Space")
    box.check()
    page.get_by_role("button", name="Leave the wheel").click()
    page.get_by_role("button", name="Take the wheel").click()
    assert not box.is_checked()
    camera.sees.set()


NO_FULL_SCREEN = "delete Element.prototype.requestFullscreen"


@pytest.mark.parametrize("script", ["", NO_FULL_SCREEN], ids=["full screen", "by style alone"])
def test_a_phone_drives_on_the_whole_screen(open_page, server, car, camera, script):
    page = open_car(open_page, server.invitation("#/car/car-1"), car, **PHONE)
    page.evaluate(script)
    take_the_wheel(page)
    page.get_by_role("button", name="Full screen").click()
    until(lambda: bool(page.evaluate("document.fullscreenElement")) == (script == ""), "the screen")
    for width, height in ((390, 844), (667, 320), (844, 390)):
        page.set_viewport_size({"width": width, "height": height})
        drawn(page)
        frame = page.locator(".sight-frame").bounding_box()
        assert (frame["width"], frame["height"]) == (width, height)
        places = []
        for part in (
            ".sight-age",
            ".stick",
            ".deadman",
            ".stop-press",
            ".sight header",
            ".drive header .tool >> visible=true",
        ):
            box = page.locator(part).bounding_box()
            assert box["x"] >= 0, part
            assert box["y"] >= 0, part
            assert box["x"] + box["width"] <= width, part
            assert box["y"] + box["height"] <= height, part
            places.append((part, box))
        # None covers another.
        for i, (part, a) in enumerate(places):
            for other, b in places[i + 1 :]:
                apart = (
                    a["x"] + a["width"] <= b["x"]
                    or b["x"] + b["width"] <= a["x"]
                    or a["y"] + a["height"] <= b["y"]
                    or b["y"] + b["height"] <= a["y"]
                )
                assert apart, (part, other, a, b)
        assert not page.locator(".gauge").first.is_visible()
        assert not page.get_by_role("link", name="Alarms").is_visible()
    fingers = Fingers(page)
    fingers.put(2, *middle(page, ".stick"))
    fingers.put(2, middle(page, ".stick")[0], 0)
    button = middle(page, ".deadman")
    press, release = lambda: fingers.put(1, *button), lambda: fingers.lift(1)
    hold(page, press, release, lambda: moves(camera), "the finger to move the car")
    fingers.lift(2)
    fingers.lift(1)
    until(lambda: not held(page), "the finger to let go")
    drive(page)
    page.keyboard.up("Space")
    page.get_by_role("button", name="Stop car-1").click()
    page.locator(".stop-words").get_by_text("Emergency stop: car-1 stands.").wait_for()
    page.get_by_role("button", name="Leave full screen").click()
    page.locator(".gauge").first.wait_for()
    # Escape leaves the whole screen, and not the car.
    page.get_by_role("button", name="Leave the wheel").click()
    until(lambda: not page.evaluate("!!document.fullscreenElement"), "the end of the screen")
    page.get_by_role("button", name="Full screen").click()
    if script:
        page.keyboard.press("Escape")
    else:
        until(lambda: page.evaluate("!!document.fullscreenElement"), "the screen")
        # A browser tells the page of the end alone.
        page.evaluate("document.exitFullscreen()")
    page.locator(".gauge").first.wait_for()
    assert page.url.endswith("#/car/car-1")


def test_replayed_and_garbled_messages_change_nothing(open_page, server, car, broker, camera):
    page = open_car(open_page, f"{server.url}#/car/car-1", car)
    look(page)
    sight(page, state="live", way="webrtc")
    answered, offered = list(camera.answers), offers(broker)
    topics = {topic for topic, _ in answered}
    for topic, payload in answered:
        broker.publish(topic, payload)
        broker.publish(topic, payload[:-9])
    for topic in topics | {"view/iort/car-1/picture"}:
        for garbage in (b"", b"null", b"\x04" * 40, b"\xff" * 2000, b'{"v":1,"kind":"ended","request":"x"}'):
            broker.publish(topic, garbage)
    number = int(page.get_attribute(".sight", "data-frame") or 0)
    until(lambda: int(page.get_attribute(".sight", "data-frame") or 0) > number + 20, "newer pictures")
    assert page.get_attribute(".sight", "data-way") == "webrtc"
    assert offers(broker) == offered
    looked_at(camera, 1, 0)


def test_the_picture_outlives_a_lost_connection_to_the_broker(open_page, server, car, broker, camera):
    page = open_car(open_page, f"{server.url}#/car/car-1", car)
    look(page)
    sight(page, state="live", way="webrtc")
    asked = len(broker.sent("/video"))
    broker.drop()
    until(
        lambda: "keep" in [look["kind"] for look in broker.sent("/video")[asked:]], "the lease to be renewed"
    )
    assert page.get_attribute(".sight", "data-way") == "webrtc"
    looked_at(camera, 1, 0)


def test_a_picture_that_the_browser_pauses_goes_on_beside_another_viewers(
    open_page, server, car, broker, camera
):
    page, other = (open_car(open_page, f"{server.url}#/car/car-1", car) for _ in range(2))
    for each in (page, other):
        look(each)
        sight(each, state="live", way="webrtc")
    looked_at(camera, 2, 0)
    offered = offers(broker)
    # As one that saves power does.
    page.evaluate("document.querySelector('.sight video').pause()")
    number = int(page.get_attribute(".sight", "data-frame") or 0)
    until(lambda: int(page.get_attribute(".sight", "data-frame") or 0) > number + 5, "newer pictures")
    assert page.get_attribute(".sight", "data-way") == "webrtc"
    assert offers(broker) == offered
    other.get_by_role("button", name="Stop looking").click()
    looked_at(camera, 1, 0)
    sight(page, state="live")


LIGHT, DARK = {**DESKTOP, "color_scheme": "light"}, {**PHONE, "color_scheme": "dark"}


@pytest.mark.parametrize("device", [LIGHT, DARK], ids=["desktop", "phone"])
def test_the_picture_is_accessible_in_every_state(open_page, server, car, camera, device):
    page = open_car(open_page, server.invitation("#/car/car-1"), car, reduced_motion="reduce", **device)
    page.evaluate(AXE.read_text())
    take_the_wheel(page)
    faults = {"live": violations(page)}
    page.get_by_role("button", name="Full screen").click()
    faults["whole"] = violations(page)
    camera.sees.clear()
    sight(page, state="frozen")
    faults["frozen, whole"] = violations(page)
    page.get_by_role("button", name="Leave full screen").click()
    faults["frozen"] = violations(page)
    if device is DARK:
        faults["small"] = page.evaluate(SMALL, TARGET_PX)
    assert {state: found for state, found in faults.items() if found} == {}
    assert page.evaluate(BEYOND) <= 0
    camera.sees.set()
