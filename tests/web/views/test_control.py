"""A car's controls in a browser: commands, settings, and driving by keys, mouse and touch."""

from __future__ import annotations

import json

import pytest

from iort_station.errors import StationError
from testkit.waiting import until
from tests.browser import drawn, show
from tests.web.lab import NOW_S


def setting(name, kind, value, *, desired=False):
    entry = {"name": name, "kind": kind, "value": value, "desired": desired, "pending": None, "reason": ""}
    return {**entry, "low": 0.1, "high": 10.0, "unit": "Hz" if kind == "number" else "", "names": []}


class Robot:
    """Answers commands as told, and keeps them."""

    def __init__(self):
        self.sent = []
        self.online = True
        entries = (
            setting("live.rate_hz", "number", "10"),
            setting("fields.vesc", "fields", "speed", desired=True),
        )
        self.entries = {entry["name"]: entry for entry in entries}
        self.answer = {"accepted": True, "reason": "", "after_ms": 400}

    def settings(self, _asked):
        return {"settings": [dict(entry) for entry in self.entries.values()], "online": self.online}

    def set(self, asked):
        """Take all but rates above 5 Hz."""
        self.sent.append(dict(asked))
        entry = self.entries[asked["name"]]
        if not self.online:
            entry |= {"pending": asked["value"], "desired": True}
        elif "value" not in asked:
            entry |= {"value": "10", "desired": False}
        elif float(asked["value"]) > 5:
            return self.settings({}) | {"settings": [{**entry, "reason": "rate_hz must be at most 5"}]}
        else:
            entry |= {"value": asked["value"], "desired": True}
        return self.settings({})

    def send(self, asked):
        self.sent.append({**asked, "message": json.loads(asked["message"])})
        if asked["command"] == "nothing":
            raise StationError("there is no such command")
        return self.answer


@pytest.fixture
def robot():
    return Robot()


@pytest.fixture
def invite(serve, robot):
    return serve(actions={"send": robot.send, "settings": robot.settings, "set": robot.set}).invitation


def test_a_command_is_sent_and_its_answer_shown(open_page, invite, robot, car):
    page = open_page(invite("#/car/car-1"))
    show(page, car.send())
    page.get_by_role("heading", name="Commands").click()
    said = page.locator(".control .said")
    page.fill("[name=speed]", "1.2")
    page.fill("[name=turn]", "-0.1")
    page.fill("[name=lease]", "800")
    page.get_by_role("button", name="Send").click()
    until(lambda: said.inner_text() == "drive accepted after 0.4 s", "the answer")
    drive = {"robot": "car-1", "command": "drive", "lease_ms": "800"}
    assert robot.sent == [{**drive, "message": {"drive": {"speed": 1.2, "steering_angle": -0.1}}}]
    robot.answer = {"accepted": False, "reason": "clock_offset_unknown", "after_ms": 300}
    page.get_by_role("button", name="Stop").click()
    until(lambda: said.inner_text() == "drive rejected: clock offset unknown", "the rejection")
    # Nobody needs a picture to let it stand.
    assert robot.sent[1]["message"] == {"drive": {"speed": 0, "steering_angle": 0}}
    assert robot.sent[1]["blind"] == "true"
    robot.answer = {"accepted": None, "reason": "", "after_ms": 10_000}
    page.select_option("[name=type]", "JSON")
    page.fill("[name=message]", '{"data": true')
    page.get_by_role("button", name="Send").click()
    until(lambda: "must be JSON" in said.inner_text(), "the refusal")
    page.fill("[name=message]", '{"data": true}')
    page.fill("[name=command]", "horn")
    page.fill("[name=lease]", "")
    page.get_by_role("button", name="Send").click()
    until(lambda: "No answer within 10 s" in said.inner_text(), "the end of the wait")
    assert robot.sent[2] == {"robot": "car-1", "command": "horn", "lease_ms": "", "message": {"data": True}}
    page.get_by_label("Blind", exact=True).check()
    page.fill("[name=command]", "nothing")
    page.get_by_role("button", name="Send").click()
    until(lambda: said.inner_text() == "there is no such command", "the server's refusal")
    assert robot.sent[3]["blind"] == "true"


def test_a_setting_is_checked_changed_and_reset(open_page, invite, robot, car):
    page = open_page(invite("#/car/car-1"))
    show(page, car.send())
    page.get_by_role("heading", name="Settings").click()
    rate, row = page.locator("[name='live.rate_hz']"), page.locator(".setting").first
    until(lambda: rate.count() == 1 and rate.input_value() == "10", "the value in force")
    # A stream's fields can be selected, too.
    assert page.locator(".setting [name='fields.vesc']").count() == 1
    rate.fill("11")
    row.get_by_role("button", name="Set").click()
    assert not robot.sent
    rate.fill("8")
    row.get_by_role("button", name="Set").click()
    until(lambda: "rejected: rate_hz must be at most 5" in row.inner_text(), "the rejection")
    assert rate.input_value() == "10"
    rate.fill("2.5")
    row.get_by_role("button", name="Set").click()
    until(lambda: row.get_by_role("button", name="Reset").is_visible(), "the new value")
    assert (rate.input_value(), robot.sent[-1]["value"]) == ("2.5", "2.5")
    row.get_by_role("button", name="Reset").click()
    until(lambda: rate.input_value() == "10", "the file's value")
    robot.online = False
    rate.fill("3")
    row.get_by_role("button", name="Set").click()
    until(lambda: "pending; in force is 10" in row.inner_text(), "the pending value")
    fields = page.locator(".setting", has=page.locator("[name='fields.vesc']"))
    fields.locator("input").fill("")
    fields.locator("[type=submit]").click()
    until(lambda: "all fields are pending; in force is speed" in fields.inner_text(), "the pending selection")
    assert fields.locator("input").input_value() == ""


def test_a_note_is_written_marked_in_the_history_and_deleted(open_page, lab, server):
    page = open_page(server.invitation())
    page.goto(
        f"{server.url}#/history/car-1?stream=vesc&from=2026-05-04T10:00:00.000Z"
        "&to=2026-05-04T10:01:00.000Z&at=2026-05-04T10:00:30.000Z"
    )
    chart = page.locator(".history .charts .plot canvas").first
    chart.wait_for()
    page.locator(".scrub-at").filter(has_text="10:00:30").wait_for()
    drawn(page)
    before = chart.screenshot()
    page.fill("[name=note]", "<b>hit</b> the wall")
    page.get_by_role("button", name="Add note").click()
    # About the cursor's time, and as text.
    page.locator(".history .notes-list li[data-note]").get_by_text("<b>hit</b> the wall").wait_for()
    assert abs(lab.notes[-1]["t_us"] - 1_777_888_830_000_000) < 500_000
    drawn(page)
    assert chart.screenshot() != before
    # A note links to its time.
    page.goto(f"{server.url}#/insights/car-1")
    page.locator(".insights-view .notes-list a").last.click()
    page.locator(".scrub-at").filter(has_text="10:00:").wait_for()
    page.locator(".history .notes-list li[data-note]").wait_for()
    buttons = page.locator(".history .notes-list").get_by_role("button")
    buttons.filter(has_text="Delete").click()
    # Another viewer writes a note, and the list is filled again: the question stays.
    lab.write({"robot": "car-1", "text": "another lap", "t_us": "1777888840000000"})
    page.evaluate("location.hash = location.hash.replace(/&at=.*/, '&at=2026-05-04T10:00:35.000Z')")
    page.locator(".history .notes-list").get_by_text("another lap").wait_for()
    buttons.filter(has_text="Really").click()
    until(lambda: page.locator(".history .notes-list li[data-note]").count() == 1, "the other note alone")
    assert [one["text"] for one in lab.notes] == ["changed the left front tyre", "another lap"]


def test_one_press_stops_a_car_or_the_fleet_and_only_a_release_asks(open_page, lab, server):
    lab.confirms = False
    page = open_page(server.invitation())
    words = page.locator(".stop-words")
    # No car has been heard: it can be stopped all the same.
    page.goto(f"{server.url}#/car/car-1")
    page.get_by_role("button", name="Stop car-1").click()
    page.locator(".stop-moves").get_by_text("NOT standing: car-1 (not confirmed).").wait_for()
    lab.cars["car-1"][1] = lab.confirms = True
    stands = "Emergency stop: car-1 stands."
    until(lambda: words.inner_text().startswith(stands), "the car's confirmation")
    assert "Stopped by operator@lab, " in words.inner_text()
    # On every view, and in a browser that comes later and may only look.
    page.goto(f"{server.url}#/alarms")
    assert words.inner_text() == f"{stands} Stopped alone: car-1, to be released on the car's page."
    assert not page.get_by_role("button", name="Release all").is_visible()
    onlooker = open_page(f"{server.url}#/insights")
    onlooker.get_by_text("Emergency stop: car-1 stands.").wait_for()
    assert onlooker.locator(".stop-press, .stop-release:visible").count() == 0
    page.goto(f"{server.url}#/")
    page.get_by_role("button", name="Stop all").click()
    both = "Emergency stop: car-1, car-9 stand."
    until(lambda: words.inner_text().startswith(both), "the fleet to stand")
    page.get_by_role("button", name="Release all").click()
    assert [asked["stopped"] for asked in lab.asked] == ["true", "true"]
    # Only what the fleet's stop has stopped.
    page.get_by_role("button", name="Really release car-9: it may move").click()
    until(lambda: words.inner_text().startswith(stands), "the release of car-9")
    assert lab.asked[-1] == {"stopped": "false", "seen_ms": str(round(NOW_S * 1000))}
    page.goto(f"{server.url}#/car/car-1")
    page.get_by_role("button", name="Release car-1").click()
    page.get_by_role("button", name="Really release car-1").click()
    until(lambda: not words.is_visible(), "the release")
    assert lab.asked[-1] == {"stopped": "false", "robot": "car-1", "seen_ms": str(round(NOW_S * 1000))}
    server.stop()
    page.evaluate("document.dispatchEvent(new Event('visibilitychange'))")
    page.get_by_text("The page's server does not answer: nobody can be stopped here").wait_for()


def test_only_a_browser_that_was_invited_may_act(open_page, invite, car):
    address = invite("#/car/car-1")
    page = open_page(address.partition("?")[0])
    show(page, car.send())
    commands = page.get_by_role("heading", name="Commands")
    banner = page.locator(".read-only")
    assert "Read-only: this page was opened without a link" in banner.inner_text()
    assert "iort invite" in banner.inner_text()
    assert not commands.is_visible()
    assert page.evaluate("document.documentElement.scrollWidth <= innerWidth")
    # In the same tab, only what follows the # is another.
    with page.expect_event("load"):
        page.goto(address)
    until(lambda: page.evaluate("window.iort?.link") == "live", "the page to connect")
    show(page, car.send())
    assert commands.is_visible()
    assert not banner.is_visible()
    assert page.url == address.partition("?")[0]
    # The address was used, and this browser keeps the key.
    again = page.context.new_page()
    again.goto(address)
    until(lambda: again.evaluate("window.iort?.link") == "live", "another tab to connect")
    show(again, car.send())
    assert again.get_by_role("heading", name="Commands").is_visible()
    # Another browser cannot use it again, and is told so.
    other = open_page(address)
    assert "Read-only: this address was used before" in other.inner_text(".read-only")


PHONE = {"viewport": {"width": 390, "height": 844}, "has_touch": True, "is_mobile": True}


class Fingers:
    """Fingers on a screen: each by its number, where it is."""

    def __init__(self, page):
        self._send = page.context.new_cdp_session(page).send
        self._down = {}

    def put(self, finger, x, y):
        """Put it down, or move it."""
        kind = "touchMove" if finger in self._down else "touchStart"
        self._down[finger] = (x, y)
        self._touch(kind, self._down)

    def lift(self, finger):
        self._touch("touchEnd", {finger: self._down.pop(finger)})

    def cancel(self):
        """The system takes all of them: a call, a gesture of its own."""
        self._down.clear()
        self._touch("touchCancel", {})

    def _touch(self, kind, fingers):
        points = [{"id": finger, "x": x, "y": y} for finger, (x, y) in fingers.items()]
        self._send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": points})


def at_the_wheel(page, car):
    show(page, car.send())
    page.get_by_role("button", name="Take the wheel").click()
    page.locator(".deadman").scroll_into_view_if_needed()


def held(page):
    return page.get_attribute(".deadman", "data-held") == "true"


def knob(page):
    """Where it is, to the right and ahead."""
    where = "(node) => ['--x', '--y'].map((name) => Number(node.style.getPropertyValue(name)))"
    x, y = page.locator(".knob").evaluate(where)
    return x, -y


def middle(page, selector):
    box = page.locator(selector).bounding_box()
    assert box is not None
    return box["x"] + box["width"] / 2, box["y"] + box["height"] / 2


def test_a_finger_that_is_lifted_or_lost_lets_go(open_page, server, car):
    page = open_page(server.invitation("#/car/car-1"), **PHONE)
    at_the_wheel(page, car)
    fingers, button, stick = Fingers(page), middle(page, ".deadman"), middle(page, ".stick")
    fingers.put(1, *button)
    until(lambda: held(page), "the finger on the button")
    # It leaves the stick at the screen's edge, where the stick follows.
    fingers.put(2, *stick)
    fingers.put(2, 0, 0)
    until(lambda: knob(page) == (-1, 1), "the stick to follow a finger")
    # A third finger, on the stick and on the button, neither moves the stick nor lets go.
    for place in (stick, button):
        fingers.put(3, *place)
        fingers.lift(3)
        assert (held(page), knob(page)) == (True, (-1, 1))
    fingers.lift(1)
    until(lambda: not held(page), "the button to be let go, and the stick not")
    assert knob(page) == (-1, 1)
    fingers.put(1, *button)
    until(lambda: held(page), "the button to be held again")
    fingers.lift(2)
    until(lambda: knob(page) == (0, 0), "the stick to return")
    assert held(page)
    fingers.cancel()
    until(lambda: not held(page), "the touch to be lost")


def test_a_gamepad_that_is_let_go_or_lost_lets_go(open_page, server, car):
    page = open_page(server.invitation("#/car/car-1"))
    page.evaluate("navigator.getGamepads = () => [null, window.gamepad ?? null]")

    def pad(*axes, pressed=False):
        held = f"{{ pressed: {str(pressed).lower()} && i === 5 }}"
        buttons = f"Array.from({{ length: 8 }}, (_, i) => ({held}))"
        told = f"connected: true, mapping: 'standard', axes: [{', '.join(axes)}], buttons: {buttons}"
        page.evaluate(f"window.gamepad = {{ {told} }}")

    def phase(wanted):
        """A hold that cannot begin, because there is no broker, is over until it is let go."""
        page.locator(f".drive[data-phase={wanted}]").wait_for()

    at_the_wheel(page, car)
    pad("0", "-1")
    until(lambda: knob(page) == (0, 1), "the stick to follow the gamepad")
    pad("0", "-1", pressed=True)
    phase("over")
    pad("NaN", "NaN", "Infinity", pressed=True)
    until(lambda: knob(page) == (1, 0), "values that are no numbers to push nowhere")
    pad("0", "0")
    phase("free")
    pad("0", "-1", pressed=True)
    phase("over")
    # It is gone, with its button held, and comes back so.
    page.evaluate("window.gamepad = undefined")
    phase("free")
    assert knob(page) == (0, 0)
    pad("0", "-1", pressed=True)
    until(lambda: knob(page) == (0, 1), "the gamepad to be back")
    phase("free")
    # A browser that shows no gamepads, as at http:// on another computer.
    page.evaluate("delete navigator.getGamepads, delete Navigator.prototype.getGamepads")
    page.keyboard.down("Space")
    phase("over")
    page.keyboard.up("Space")
    phase("free")
