"""The dead-man's switch in a real browser: fingers on a phone's screen, and a gamepad."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

from testkit.waiting import until
from tests.browser import show
from tests.web.cars import Car
from tests.web.lab import Lab

if TYPE_CHECKING:
    from playwright.sync_api import Page

    from local.pubnub.standin import PubNubStandIn

PHONE: dict[str, Any] = {"viewport": {"width": 390, "height": 844}, "has_touch": True, "is_mobile": True}


class Fingers:
    """Fingers on a screen: each by its number, where it is."""

    def __init__(self, page: Page) -> None:
        self._send = page.context.new_cdp_session(page).send
        self._down: dict[int, tuple[float, float]] = {}

    def put(self, finger: int, x: float, y: float) -> None:
        """Put it down, or move it."""
        kind = "touchMove" if finger in self._down else "touchStart"
        self._down[finger] = (x, y)
        self._touch(kind, self._down)

    def lift(self, finger: int) -> None:
        self._touch("touchEnd", {finger: self._down.pop(finger)})

    def cancel(self) -> None:
        """The system takes all of them: a call, a gesture of its own."""
        self._down.clear()
        self._touch("touchCancel", {})

    def _touch(self, kind: str, fingers: Mapping[int, tuple[float, float]]) -> None:
        points = [{"id": finger, "x": x, "y": y} for finger, (x, y) in fingers.items()]
        self._send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": points})


def at_the_wheel(page: Page, car: Car) -> None:
    show(page, car.send())
    page.get_by_role("button", name="Take the wheel").click()
    page.locator(".deadman").scroll_into_view_if_needed()


def held(page: Page) -> bool:
    return page.get_attribute(".deadman", "data-held") == "true"


def knob(page: Page) -> tuple[float, float]:
    """Where it is, to the right and ahead."""
    where = "(node) => ['--x', '--y'].map((name) => Number(node.style.getPropertyValue(name)))"
    x, y = page.locator(".knob").evaluate(where)
    return x, -y


def middle(page: Page, selector: str) -> tuple[float, float]:
    box = page.locator(selector).bounding_box()
    assert box is not None
    return box["x"] + box["width"] / 2, box["y"] + box["height"] / 2


def test_a_finger_that_is_lifted_or_lost_lets_go(
    open_page: Callable[..., Page], pubnub: PubNubStandIn, car: Car
) -> None:
    with Lab().server(pubnub) as server:
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


def test_a_gamepad_that_is_let_go_or_lost_lets_go(
    open_page: Callable[..., Page], pubnub: PubNubStandIn, car: Car
) -> None:
    with Lab().server(pubnub) as server:
        page = open_page(server.invitation("#/car/car-1"))
        page.evaluate("navigator.getGamepads = () => [null, window.gamepad ?? null]")

        def pad(*axes: str, pressed: bool = False) -> None:
            buttons = (
                f"Array.from({{ length: 8 }}, (_, i) => ({{ pressed: {str(pressed).lower()} && i === 5 }}))"
            )
            told = f"connected: true, mapping: 'standard', axes: [{', '.join(axes)}], buttons: {buttons}"
            page.evaluate(f"window.gamepad = {{ {told} }}")

        def phase(wanted: str) -> None:
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
